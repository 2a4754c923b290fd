"""The command line. Each command imports what it needs when it runs, so that `--help` is quick.

Exit codes follow sysexits.h: 65 a data file that cannot be used, 69 a package that a command needs
is not installed or a daemon that does not answer, 74 a file that cannot be written, 78 a
configuration mistake; 2 a wrong command line; 130 after Ctrl-C.
"""

from __future__ import annotations

import atexit
import gc
import os
import sys
import threading
from collections.abc import Callable, Iterable
from contextlib import suppress
from typing import Annotated, NoReturn

import typer

from fusiond.commands import (
    batch,
    configure,
    daemon,
    dashboard,
    models_and_studies,
    offline,
    recordings,
    reporting,
)
from fusiond.commands.status import status

# Imports make half a million objects that live for ever. At CPython's own threshold of 700 the
# collector looks through them again and again: 0.2 s of the processor's time until a command begins
# its work, which sets a lower one (`fusiond.commands.shared.freeze_imports`).
COLLECT_AFTER = 1_000_000


def _root(
    version: Annotated[bool, typer.Option("--version", help="Show the version and exit.")] = False,
) -> None:
    if version:
        from importlib.metadata import version as installed  # noqa: PLC0415

        typer.echo(f"fusiond {installed('fusiond')}")
        raise typer.Exit


# In the order of `--help`.
COMMANDS = (
    *(daemon.run, daemon.demo, dashboard.dashboard, daemon.check, daemon.doctor, status),
    *(recordings.replay, reporting.report),
    *(offline.process, offline.calibrate, offline.simulate, offline.compare),
    batch.batch,
    *(
        models_and_studies.schema,
        models_and_studies.study,
        models_and_studies.model,
        models_and_studies.bench,
    ),
)


def command_line(commands: Iterable[Callable[..., None]]) -> typer.Typer:
    """Command-line application with these commands."""
    made = typer.Typer(
        help="Inertial navigation aided by BeiDou RDSS and GNSS.",
        no_args_is_help=True,
        # Asked for by the shell's script alone (docs/install.md): no option of it clutters
        # `--help`.
        add_completion="_FUSIOND_COMPLETE" in os.environ,
        pretty_exceptions_enable=False,
        rich_markup_mode="rich" if sys.stdout.isatty() and sys.stderr.isatty() else None,
        context_settings={"help_option_names": ["-h", "--help"]},
    )
    made.callback(invoke_without_command=True)(_root)
    for command in commands:
        made.command()(command)
    return made


app = command_line(COMMANDS)
app.add_typer(configure.config, name="config")
app.add_typer(recordings.log, name="log")


def main() -> None:
    """Entry point of the console script."""
    gc.set_threshold(COLLECT_AFTER)
    # A filter's matrices are too small to be shared: further threads of the linear algebra only
    # spin, 0.15 s of the processor's time each time that they have nothing to do.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # fusiond has no use for plugins of pydantic; to look for some reads the metadata of every
    # installed package. (https://docs.pydantic.dev/latest/concepts/plugins)
    os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")
    try:
        # Of a command the options of that one: those of all take 30 ms to make.
        named = [command for command in COMMANDS if sys.argv[1:2] == [command.__name__]]
        (command_line(named) if named else app)()
    except KeyboardInterrupt:
        _leave(130)
    except SystemExit as ended:
        _leave(ended.code)
    finally:
        # The interpreter's last two collections would look through all that was imported, a quarter
        # of a second for nothing: the process and its memory end.
        gc.freeze()


def _leave(code: int | str | None) -> NoReturn:
    """End the process without freeing its memory object by object. Freeing every import takes a
    twentieth of the processor time of a start. With other threads, a tracer or a profiler the
    process ends the ordinary way."""
    alone = threading.active_count() == 1 and not (sys.gettrace() or sys.getprofile())
    if alone and not isinstance(code, str):
        atexit._run_exitfuncs()
        with suppress(OSError, ValueError):  # full, gone or closed: the interpreter tells it
            print(end="", flush=True)
            print(end="", flush=True, file=sys.stderr)
            os._exit(code or 0)
    sys.exit(code)
