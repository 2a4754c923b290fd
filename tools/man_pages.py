"""The manual pages fusiond(1) and fusiond.toml(5), from the commands and the schema themselves.

    python -m tools.man_pages [FOLDER]      build/man by default

`make man` does it. Written for man(7), as groff reads it.
"""

from __future__ import annotations

import ast
import inspect
import re
import sys
import textwrap
from collections.abc import Iterator
from importlib.metadata import version
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, get_args, get_origin

import typer
from pydantic import BaseModel
from pydantic.fields import FieldInfo

from fusiond.commands.app import app
from fusiond.configuration import aiding, outputs, schema
from fusiond.configuration.alignment import Alignment
from fusiond.configuration.constraints import NonHolonomic, ZeroVelocity
from fusiond.configuration.load import driver_entry_points
from fusiond.configuration.mistakes import described

EXIT_CODES = (
    ("0", "it went well"),
    ("1", "doctor found something, replay differs, status has no usable solution"),
    ("2", "a wrong command line"),
    ("65", "a data file that cannot be used, or with which nothing was navigated"),
    ("69", "a package that the command needs is not installed, or no daemon answers"),
    ("74", "a file that cannot be written"),
    ("78", "a mistake in the configuration"),
    ("130", "Ctrl-C"),
)
FILES = (
    ("/etc/fusiond/vehicle.toml", "configuration of the daemon that systemd runs"),
    ("/etc/fusiond/environment", "FUSIOND_MQTT_PASSWORD=..., mode 0600"),
    ("/var/lib/fusiond", "last solution, calibration, recordings"),
    ("/var/cache/fusiond", "compiled kernels"),
)
ENVIRONMENT = (
    ("FUSIOND_MQTT_PASSWORD", "password of the broker, before mqtt.password_file"),
    ("NUMBA_CACHE_DIR", "folder of the compiled kernels; $XDG_CACHE_HOME/fusiond by default"),
)
_PARTS: dict[str, type[BaseModel]] = {
    "imu": schema.Imu,
    "constraints.zero_velocity": ZeroVelocity,
    "constraints.non_holonomic": NonHolonomic,
    "alignment": Alignment,
    "consistency": schema.ConsistencyTest,
    "scheduler": schema.Scheduler,
    "clock": schema.ClockOptions,
    "mqtt": schema.Mqtt,
}


def escaped(text: str) -> str:
    """Text as roff takes it: no line is a request, no hyphen is broken at."""
    text = " ".join(text.split()).replace("\\", r"\e").replace("-", r"\-")
    return rf"\&{text}" if text.startswith((".", "'")) else text


def _heading(name: str, section: int, what: str) -> Iterator[str]:
    yield f'.TH {name.upper()} {section} "" "fusiond {version("fusiond")}" "fusiond"'
    yield ".SH NAME"
    yield f"{escaped(name)} \\- {escaped(what)}"


def _table(title: str, rows: tuple[tuple[str, str], ...]) -> Iterator[str]:
    yield f".SH {title}"
    for name, text in rows:
        yield ".TP"
        yield rf"\fB{escaped(name)}\fR"
        yield escaped(text)


# --------------------------------------------------------------------------- fusiond(1)


def commands_page() -> str:
    """fusiond(1)."""
    root: Any = typer.main.get_command(app)  # of click, or of typer's own copy of it
    lines = [*_heading("fusiond", 1, "inertial navigation aided by BeiDou RDSS and GNSS")]
    lines += [".SH SYNOPSIS", r"\fBfusiond\fR \fICOMMAND\fR [\fIOPTIONS\fR]", ".SH DESCRIPTION"]
    lines.append(
        escaped(
            "A daemon for a vehicle computer: it reads an IMU from a CAN bus, a BeiDou RDSS "
            "terminal and a GNSS receiver from serial lines, and publishes position, velocity "
            "and attitude, each with its sigma, over MQTT. Its configuration is fusiond.toml(5)."
        )
    )
    lines.append(".SH COMMANDS")
    for name, command in root.commands.items():
        lines += _command(f"fusiond {name}", command)
    for title, rows in (
        ("EXIT STATUS", EXIT_CODES),
        ("FILES", FILES),
        ("ENVIRONMENT", ENVIRONMENT),
    ):
        lines += _table(title, rows)
    lines += [".SH SEE ALSO", r"\fBfusiond.toml\fR(5), \fBmosquitto_sub\fR(1), \fBcandump\fR(1)"]
    return "\n".join(lines) + "\n"


def _command(path: str, command: Any) -> Iterator[str]:
    if hasattr(command, "commands"):
        for name, sub in command.commands.items():
            yield from _command(f"{path} {name}", sub)
        return
    context = command.context_class(command, info_name=path)
    yield ".SS " + escaped(f"{path} {' '.join(command.collect_usage_pieces(context))}")
    for paragraph in inspect.cleandoc(command.help or "").split("\n\n"):
        yield from _kept(paragraph) if paragraph.startswith("\b") else [escaped(paragraph)]
        yield ".PP"
    for parameter in command.params:
        record = parameter.get_help_record(context)
        if record is not None and not getattr(parameter, "is_eager", False):
            yield ".TP"
            yield rf"\fB{escaped(record[0])}\fR"
            yield escaped(re.sub(r"\s+", " ", record[1] or "as its name says")) or r"\&"


def _kept(paragraph: str) -> Iterator[str]:
    """Lines that stay lines, which the command line marks by a backspace."""
    yield ".nf"
    for line in paragraph.splitlines()[1:]:
        yield "    " * line.startswith(" ") + escaped(line)
    yield ".fi"


# --------------------------------------------------------------------------- fusiond.toml(5)


def configuration_page() -> str:
    """fusiond.toml(5)."""
    lines = [*_heading("fusiond.toml", 5, "configuration of the navigation daemon fusiond")]
    lines.append(".SH DESCRIPTION")
    lines.append(
        escaped(
            "One TOML file a vehicle. Units stand in the names; numbers are those that data sheets "
            "print. Unknown keys are mistakes, which `fusiond check` lists; paths count from the "
            "file's own folder. `fusiond config init` writes a first file."
        )
    )
    lines += [".SH TOP LEVEL"]
    texts = _texts(schema.Config)
    for name, model_field in schema.Config.model_fields.items():
        if not _sections(model_field.annotation):
            lines += _key(name, model_field, texts.get(name, ""))
    for name, model in _all_sections().items():
        lines += [f".SH [{escaped(name)}]", *_about(model)]
        texts = _texts(model)
        for key, model_field in model.model_fields.items():
            if not _sections(model_field.annotation):
                lines += _key(key, model_field, texts.get(key, ""))
    for name, point in sorted(driver_entry_points().items()):
        options = point.load().Options
        lines += [f".SH [sources.NAME] driver = \\(dq{escaped(name)}\\(dq", *_about(options)]
        texts = _texts(options)
        for key, model_field in options.model_fields.items():
            lines += _key(key, model_field, texts.get(key, ""))
    lines += [".SH SEE ALSO", r"\fBfusiond\fR(1)"]
    return "\n".join(lines) + "\n"


def _all_sections() -> dict[str, type[BaseModel]]:
    """Every section by its name in the file."""
    kinds = get_args(get_args(aiding.AnyAiding)[0])
    found = dict(_PARTS)
    found |= {f"aiding.{kind.model_fields['kind'].default}": kind for kind in kinds}
    for name in ("imu", "estimator", "integrity", "position_reports", "recording", "outputs"):
        (model,) = _sections(schema.Config.model_fields[name].annotation)
        found[name] = model
        for key, model_field in model.model_fields.items():
            for part in _sections(model_field.annotation):
                found[f"{name}.{key}"] = part
    assert found["outputs"] is outputs.Outputs
    return found


def _sections(annotation: Any) -> list[type[BaseModel]]:
    """The models that a key may hold: it is a section then."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    if get_origin(annotation) in (tuple, list):
        return []
    return [model for arm in get_args(annotation) for model in _sections(arm)]


def _about(model: type[BaseModel]) -> Iterator[str]:
    text = inspect.getdoc(model) if model.__doc__ else None
    if text:
        yield escaped(text)


def _texts(model: type[BaseModel]) -> dict[str, str]:
    """What stands below each key in the source of the model and of those that it is made from."""
    found: dict[str, str] = {}
    for base in reversed(model.__mro__):
        if not issubclass(base, BaseModel) or base is BaseModel:
            continue
        (tree,) = ast.parse(textwrap.dedent(inspect.getsource(base))).body
        assert isinstance(tree, ast.ClassDef)
        for key, below in pairwise(tree.body):
            match key, below:
                case ast.AnnAssign(target=ast.Name(id=name)), ast.Expr(
                    value=ast.Constant(value=str(text))
                ):
                    found[name] = text
    return found


def _key(name: str, model_field: FieldInfo, text: str = "") -> Iterator[str]:
    value = model_field.get_default(call_default_factory=False)
    default = "required" if model_field.is_required() else f"default {_shown(value)}"
    annotation = model_field.annotation
    if model_field.metadata:
        annotation = Annotated[(annotation, *model_field.metadata)]  # type: ignore[assignment]
    kind = described(annotation)
    yield ".TP"
    yield rf"\fB{escaped(name)}\fR ({escaped(f'{kind}; {default}')})"
    yield escaped(text) or r"\&"


def _shown(value: Any) -> str:
    if value is None:
        return "none"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        return f"[{', '.join(map(_shown, value))}]"
    return f'"{value}"' if isinstance(value, str | Path) else str(value)


def main() -> None:
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else "build/man")
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in (("fusiond.1", commands_page()), ("fusiond.toml.5", configuration_page())):
        (folder / name).write_text(text, encoding="utf-8")
        print(folder / name)


if __name__ == "__main__":
    main()
