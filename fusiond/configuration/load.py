"""Reader of a vehicle's configuration; errors name file, key, value and remedy.

Every mistake in the file is listed, not the first alone; `fusiond.configuration.mistakes` words
them.
"""

from __future__ import annotations

import hashlib
import json
import tomllib
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import BaseModel

from drivers.base import PermanentDriverError, monotonic_ns
from fusiond.configuration.aiding import (
    AnyAiding,
    BarometerAiding,
    CompassAiding,
    GnssAiding,
    HeightAiding,
    RawAiding,
    RdssAiding,
    SarAiding,
    StarTrackerAiding,
    WheelAiding,
)
from fusiond.configuration.mistakes import Location, did_you_mean, mistake, validate
from fusiond.configuration.schema import Config, Source

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

EXIT_CONFIG = 78
"""EX_CONFIG of sysexits.h; systemd's RestartPreventExitStatus knows it."""

_DEFAULT_AIDING: dict[str, type[AnyAiding]] = {
    "nmea": GnssAiding,
    "bestpos": GnssAiding,
    "sbf": GnssAiding,
    "ubx": GnssAiding,
    "gnss": RawAiding,
    "rdss": RdssAiding,
    "can_attitude": StarTrackerAiding,
    "can_bearing": SarAiding,
    "can_gnss": GnssAiding,
    "can_height": HeightAiding,
    "compass": CompassAiding,
    "can_wheel": WheelAiding,
    "obd_speed": WheelAiding,
}


class ConfigError(Exception):
    """The configuration cannot be used; the text has one line for each mistake."""


def load_config(path: Path | str) -> Config:
    """Read and validate a configuration file with its drivers' options.

    Relative paths in it count from the file's own folder. A source whose driver sends fixes and
    that has no `[aiding]` section gets that section's defaults. Raises `ConfigError`.
    """
    path = Path(path)
    try:
        text = path.read_bytes().decode("utf-8")
    except OSError as error:
        reason = error.strerror or str(error)
        raise ConfigError(f"{path}: {reason}: give the path of a configuration file") from error
    except UnicodeDecodeError as error:
        line = error.object.count(b"\n", 0, error.start) + 1
        raise ConfigError(f"{path}: line {line}: not UTF-8 text, which TOML must be") from error
    try:
        data = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{path}: not valid TOML: {error}") from error

    config, found = validate(Config, data)
    options = _driver_options(data.get("sources"), found, path.parent)
    if config is None or found:
        raise ConfigError("\n".join(f"{path}: {line}" for line in found))
    config = _resolve_paths(config, path.parent)
    sources = {
        name: source.model_copy(update=options[name]) for name, source in config.sources.items()
    }
    defaults = {
        name: _default_aiding(source)
        for name, source in sources.items()
        if name not in config.aiding and source.driver in _DEFAULT_AIDING
    }
    aiding = {**config.aiding, **defaults}
    return config.model_copy(update={"sources": sources, "aiding": aiding})


def _default_aiding(source: Source) -> AnyAiding:
    """Section `[aiding]` of a source without one."""
    o = source.options
    if source.driver == "can_height" and ("pressure" in o or o.get("barometric")):
        return BarometerAiding()
    return _DEFAULT_AIDING[source.driver]()


def dumped(config: Config) -> dict[str, Any]:
    """Configuration as JSON, complete but for keys whose absence has a meaning: a lever arm that is
    not given is estimated."""
    data = config.model_dump(mode="json")
    for name, section in config.aiding.items():
        if isinstance(section, GnssAiding) and "lever_arm_m" not in section.model_fields_set:
            del data["aiding"][name]["lever_arm_m"]
    return data


def config_digest(config: Config) -> str:
    """Twelve hexadecimal digits that change with any value of the configuration."""
    text = json.dumps(dumped(config), sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:12]


# --------------------------------------------------------------------------- sources


def driver_entry_points() -> dict[str, EntryPoint]:
    """The installed drivers by name (entry-point group `fusiond.drivers`)."""
    from importlib.metadata import entry_points  # noqa: PLC0415 - a file without devices needs none

    return {entry.name: entry for entry in entry_points(group="fusiond.drivers")}


def _driver_options(sources: object, found: list[str], base: Path) -> dict[str, dict[str, Any]]:
    """Each source's path options made absolute; mistakes in any option are added to `found`."""
    drivers = driver_entry_points() if isinstance(sources, dict) else {}
    paths: dict[str, dict[str, Any]] = {}
    for name, source in sources.items() if isinstance(sources, dict) else ():
        driver = source.get("driver") if isinstance(source, dict) else None
        if not isinstance(driver, str):
            continue  # the schema has said so already
        at: Location = ("sources", name)
        if driver not in drivers:
            what = f"no such driver; {did_you_mean(driver, drivers)}"
            found.append(mistake((*at, "driver"), driver, what))
            continue
        try:
            device = drivers[driver].load()
            model: type[BaseModel] = device.Options
        except (ImportError, AttributeError) as error:
            what = f"this driver cannot be loaded: {error}"
            found.append(mistake((*at, "driver"), driver, what))
            continue
        given = {key: value for key, value in source.items() if key != "driver"}
        options, mistakes = validate(model, given, at)
        found.extend(mistakes)
        if options is None:
            continue
        absolute = _absolute(options, base)
        paths[name] = {key: str(path) for key, path in absolute.items() if key in given}
        try:  # opens no device; finds what does not fit, such as a signal that the DBC lacks
            device(name, options.model_copy(update=absolute), lambda _: None, monotonic_ns)
        except PermanentDriverError as error:
            found.append(mistake(at, {}, str(error)))
    return paths


def _absolute(section: BaseModel, base: Path) -> dict[str, Path]:
    """The paths that a section holds, counted from `base`."""
    return {
        key: base.absolute() / value
        for key in type(section).model_fields
        if isinstance(value := getattr(section, key), Path)
    }


def _resolve_paths(config: Config, base: Path) -> Config:
    mqtt = config.mqtt.model_copy(update=_absolute(config.mqtt, base))
    recording = config.recording.model_copy(update=_absolute(config.recording, base))
    served = {
        name: section.model_copy(update=_absolute(section, base))
        for name, section in config.outputs.served.items()
    }
    outputs = config.outputs.model_copy(update=served)
    of_sections = {"mqtt": mqtt, "outputs": outputs, "recording": recording}
    return config.model_copy(update={**_absolute(config, base), **of_sections})
