"""Configuration of a replay: the log's own, another file, single values changed."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from fusiond.configuration.load import ConfigError, dumped, load_config
from fusiond.configuration.schema import Config
from fusiond.recording.log_metadata import CONFIG, dbc_name
from fusiond.recording.reader import About


def replay_config(
    about: About, folder: Path, other: Path | None = None, settings: Sequence[str] = ()
) -> Config:
    """Configuration of the log or of the file `other`, with `KEY=VALUE` settings.

    The log's DBC files are laid into `folder`, which must outlast the use. Raises `ConfigError`.
    """
    if other is not None:
        data = dumped(load_config(other))
    else:
        try:
            data = json.loads(about.attachments[CONFIG])
        except (KeyError, ValueError) as error:
            raise ConfigError(f"the log has no configuration: give one ({error})") from error
        for name, source in data.get("sources", {}).items():
            dbc = about.attachments.get(dbc_name(name))
            if dbc is not None:
                path = folder / f"{name}.dbc"
                path.write_bytes(dbc)
                source["dbc"] = str(path)
    for setting in settings:
        _set(data, setting)
    try:
        return Config.model_validate(data)
    except ValidationError as error:
        lines = [
            f"{'.'.join(map(str, e['loc']))}: {e['msg']}" for e in error.errors(include_url=False)
        ]
        raise ConfigError("\n".join(lines)) from error


def _set(data: dict[str, Any], setting: str) -> None:
    key, sign, text = setting.partition("=")
    if not sign or not key:
        raise ConfigError(f"--set {setting!r}: expected KEY=VALUE, such as estimator.model=ins15")
    *path, last = key.strip().split(".")
    try:
        value = tomllib.loads(f"v = {text}")["v"]
    except tomllib.TOMLDecodeError:  # text without its quotes
        value = text.strip()
    section = data
    for name in path:
        section = section.setdefault(name, {})
        if not isinstance(section, dict):
            raise ConfigError(f"--set {setting!r}: {name} is no section")
    section[last] = value
