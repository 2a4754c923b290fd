"""Doubts: a valid configuration that cannot work, or is probably unintended.

`fusiond check` prints these; the daemon runs all the same, since a part that is missing today may
be there tomorrow. Mistakes, which keep it from running, are found by `load`.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from importlib.util import find_spec
from itertools import combinations
from math import hypot
from pathlib import Path

from fusiond.configuration.aiding import CompassAiding, GnssAiding, RawAiding, RdssAiding
from fusiond.configuration.model_fit import model_doubts
from fusiond.configuration.schema import Config
from fusiond.configuration.vehicle_class import VehicleClass
from fusiond.files.install_extra import install_command

LONGEST_M: dict[VehicleClass, float] = {
    "road": 20.0,
    "rail": 30.0,
    "marine": 400.0,
    "aircraft": 85.0,
}
"""Longest rigid body of a class, which bounds lever arms: an articulated bus (18.75 m, directive
96/53/EC), a railway coach (27.5 m, UIC 567), a container ship (400 m), the An-225 (84 m)."""

DEEPEST_M = 0.5
"""Largest depth (m) of a road vehicle's antenna below the IMU.

An IMU in a box on the roof and an antenna on the bonnet are half a metre apart on a car."""
_ANTENNAS = (GnssAiding, RawAiding, RdssAiding)

GIVES: dict[str, tuple[str, ...]] = {
    "bestpos": ("gnss", "heading"),
    "can_imu": (),
    "can_attitude": ("attitude", "star_tracker"),
    "can_bearing": ("sar",),
    "can_gnss": ("gnss",),
    "can_height": ("height", "barometer"),
    "can_wheel": ("wheel",),
    "compass": ("compass", "heading"),
    "gnss": ("raw", "gnss", "heading"),
    "nmea": ("gnss", "heading"),
    "obd_speed": ("wheel",),
    "rdss": ("rdss",),
    "sbf": ("gnss", "heading"),
    "ubx": ("gnss", "heading"),
}
"""Kinds of measurement that come of each shipped driver; of drivers in other packages nothing is
known."""


def doubts(config: Config) -> list[str]:
    """One line for each doubt, with the key and the remedy."""
    return [
        *_imu(config),
        *_ports(config),
        *_aiding(config),
        *_compass(config),
        *_lever_arms(config),
        *_files(config),
        *_start(config),
        *_filter(config),
        *model_doubts(config),
        *_outputs(config),
    ]


def _imu(config: Config) -> Iterator[str]:
    if not config.sources:
        yield "sources: none; `run` needs an IMU (`process` over files does not)"
        return
    imus = [name for name, source in config.sources.items() if source.driver == "can_imu"]
    foreign = [s.driver for s in config.sources.values() if s.driver not in GIVES]
    if not imus and not foreign:
        yield (
            "sources: no IMU: constant velocity between fixes, no attitude, and sigma grows by "
            "metres in seconds without a fix: add one (can_imu)"
        )
    spare = config.imu.spare
    if spare is not None and (spare.source not in imus or len(imus) < 2) and not foreign:
        yield (
            f"imu.spare.source = {spare.source!r}: sources need two IMUs, one of them with this "
            f"name; there {'is' if len(imus) == 1 else 'are'} "
            f"{' and '.join(imus) or 'none'}"
        )
    if len(imus) > (1 if spare is None else 2):
        first, *others = imus
        yield (
            f"sources: {' and '.join(imus)} are IMUs: the one whose samples come first is used, "
            f"the others are counted and ignored; keep {first} or {' or '.join(others)}, or make "
            f'one the spare: [imu.spare] source = "{others[-1]}"'
        )
    imu = config.imu
    if imu.rate_hz * imu.gap_s < 1.0:
        yield (
            f"imu.rate_hz = {imu.rate_hz:g}: samples {1.0 / imu.rate_hz:g} s apart, and a pause "
            f"longer than imu.gap_s = {imu.gap_s:g} s is a gap: give the rate at which they come"
        )


def _ports(config: Config) -> Iterator[str]:
    """Ports with two readers. A serial line gives each reader only a part of the bytes; a UDP port
    gives one reader all."""
    users = defaultdict(list)
    for name, source in config.sources.items():
        port = source.options.get("port")
        if isinstance(port, str) and ("://" not in port or port.startswith("udp://")):
            users[Path(port).resolve()].append((name, port))
    for sources in users.values():
        for (one, port), (other, same) in combinations(sources, 2):
            also = "" if port == same else f" (that is {port} of {one})"
            yield (
                f"sources.{other}.port = {same!r}{also}: {one} has it already, and only one driver "
                "can read a line: correct one of them"
            )


def _aiding(config: Config) -> Iterator[str]:
    for name, section in config.aiding.items():
        source = config.sources.get(name)
        kinds = None if source is None else GIVES.get(source.driver)
        if source is None or kinds is None or section.kind in kinds:
            continue
        if not kinds:
            yield f"aiding.{name}: driver {source.driver} gives no measurement: leave it out"
            continue
        yield (
            f"aiding.{name}.kind = {section.kind!r}: driver {source.driver} gives "
            f"{' or '.join(kinds)}: nothing of it will be used as {section.kind}"
        )


def _filter(config: Config) -> Iterator[str]:
    name = config.estimator.filter
    if name != "kalman":
        yield (
            f"estimator.filter = {name!r} has no bank of fault hypotheses: it names no faults of "
            "sensors and corrects none of the inertial unit "
            "(docs/diagnosis.md)"
        )


def _compass(config: Config) -> Iterator[str]:
    if find_spec("pygeomag") is not None:
        return
    for name, section in config.aiding.items():
        if isinstance(section, CompassAiding) and section.declination_deg is None:
            yield (
                f"aiding.{name}: no magnetic model is installed: {install_command('compass')}, or "
                "give declination_deg"
            )


def _lever_arms(config: Config) -> Iterator[str]:
    longest_m = LONGEST_M[config.vehicle_class]
    arms = {f"aiding.{name}": section.lever_arm_m for name, section in config.aiding.items()}
    arms["constraints.non_holonomic"] = config.constraints.non_holonomic.lever_arm_m
    for where, arm in arms.items():
        length_m = hypot(*arm)
        if length_m > longest_m:
            yield (
                f"{where}.lever_arm_m = {list(arm)}: {length_m:g} m from the IMU, on a vehicle of "
                f"class {config.vehicle_class!r}? It is in metres: forward, right, down"
            )
    if config.vehicle_class not in ("road", "rail"):
        return
    for name, section in config.aiding.items():
        if isinstance(section, _ANTENNAS) and section.lever_arm_m[2] > DEEPEST_M:
            yield (
                f"aiding.{name}.lever_arm_m = {list(section.lever_arm_m)}: the antenna would be "
                f"{section.lever_arm_m[2]:g} m below the IMU. The third number counts downwards: "
                "negative for an antenna above it"
            )


def _files(config: Config) -> Iterator[str]:
    """Files that the daemon reads at start, as far as this user can read them."""
    m = config.mqtt
    if not m.enabled:
        return
    for key in ("ca_file", "cert_file", "key_file", "password_file"):
        path = getattr(m, key)
        if path is None:
            continue
        try:
            with path.open("rb"):
                pass
        except PermissionError:
            yield f"mqtt.{key} = {str(path)!r}: you may not read it; the daemon's user must"
        except OSError as error:
            yield f"mqtt.{key} = {str(path)!r}: {error.strerror}: the daemon would not start"


def _start(config: Config) -> Iterator[str]:
    if not config.sources or config.alignment.position_deg_m is not None:
        return
    foreign = any(source.driver not in GIVES for source in config.sources.values())
    if not foreign and not any(name in config.sources for name in config.positioning):
        yield (
            "sources: none gives a position: navigation starts only after cmd/set_position or by "
            "alignment.position_deg_m"
        )


def _outputs(config: Config) -> Iterator[str]:
    served = config.outputs.served.items()
    listening = {name: port for name, s in served if (port := getattr(s, "port", None)) is not None}
    for (one, port), (other, same) in combinations(listening.items(), 2):
        if port == same:
            yield f"outputs.{other}.port = {same}: outputs.{one} listens there already"
