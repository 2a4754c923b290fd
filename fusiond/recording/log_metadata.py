"""Metadata of a log: the daemon, the vehicle and the computer that made it."""

from __future__ import annotations

import json
import platform
from collections.abc import Iterable
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from drivers.base import PermanentDriverError
from drivers.can.dbc import find_dbc
from fusiond.configuration.load import config_digest, dumped
from fusiond.configuration.schema import Config
from fusiond.recording.mcap_writer import FORMAT, About, Attachment

CONFIG = "config.json"
"""Configuration of the daemon with every default and path filled in."""
BOOT_ID = Path("/proc/sys/kernel/random/boot_id")
CPU_INFO = Path("/proc/cpuinfo")
_PACKAGES = ("numpy", "numba", "scipy", "mcap")


def about_run(config: Config, run: str, epoch_ns: int, sources: Iterable[str]) -> About:
    """Metadata of a run of the daemon. `epoch_ns`: the log's time minus the daemon's clock."""
    metadata = {
        "format": FORMAT,
        "version": version("fusiond"),
        "vehicle": config.vehicle,
        "config_digest": config_digest(config),
        "run": run,
        "epoch_ns": str(epoch_ns),
        "sources": json.dumps(list(sources)),
        "host": platform.node(),
        "system": f"{platform.system()} {platform.release()} {platform.machine()}",
        "processor": processor(),
        "python": platform.python_version(),
        "boot_id": _read(BOOT_ID).strip(),
        **_versions(),
    }
    text = json.dumps(dumped(config), indent=1)
    return About(metadata, (Attachment(CONFIG, "application/json", text.encode()), *_dbcs(config)))


def _versions() -> dict[str, str]:
    """Versions of the installed packages that affect results."""
    found = {}
    for package in _PACKAGES:
        with suppress(PackageNotFoundError):
            found[package] = version(package)
    return found


def processor() -> str:
    """Processor model; compiled code may differ between models in the last bit."""
    for line in _read(CPU_INFO).splitlines():
        if line.startswith(("model name", "Hardware", "Model")):
            return line.partition(":")[2].strip()
    return platform.processor() or "unknown"


def dbc_name(source: str) -> str:
    """Name of the attachment that holds a source's DBC file."""
    return f"dbc/{source}.dbc"


def _dbcs(config: Config) -> Iterable[Attachment]:
    for name, source in config.sources.items():
        dbc = source.options.get("dbc")
        if isinstance(dbc, str):
            try:
                yield Attachment(dbc_name(name), "text/plain", find_dbc(dbc).read_bytes())
            except (OSError, PermanentDriverError):  # the driver will say it
                continue


def _read(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8", errors="replace")
    except OSError:
        return ""
