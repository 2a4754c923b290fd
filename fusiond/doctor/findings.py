"""Catalogue of the findings of `fusiond doctor`: symptom, then what to do.

`finding(code, ...)` is the text with its figures. Findings on a receiver's bytes come from its
driver (`drivers.nmea.reasons`). docs/troubleshooting.md lists all.
"""

from __future__ import annotations

from collections.abc import Mapping

FINDINGS: Mapping[str, str] = {
    "no_sources": "No [sources]: add a [sources.NAME] section for each device",
    "driver_ended": "The driver ended ({error}): report this as a bug",
    "driver_failed": "{detail}: correct [sources.{name}] or the installation",
    # Ports
    "port_missing": (
        "{port} does not exist: plug it in, or correct port in [sources.{name}]; {others}"
    ),
    "port_not_serial": "{port} is not a serial port: correct port in [sources.{name}]",
    "port_forbidden": (
        "No permission for {port} ({mode}, group {group}): usermod -aG {group} USER, and log in "
        "again"
    ),
    "port_busy": (
        "{port} is in use by another program: stop it (systemctl stop fusiond ModemManager; "
        "fuser -v {port} names it)"
    ),
    "port_unusable": "{port} cannot be opened ({detail}): check the device",
    "port_silent": (
        "No bytes in {seconds:g} s: check power, and that its TX goes to this computer's RX"
    ),
    "port_baud": (
        "Bytes arrive, none intelligible: {baud} baud is probably not the device's rate, correct "
        "baud in [sources.{name}]"
    ),
    "server_missing": "{detail}: start its server, or correct port in [sources.{name}]",
    "server_silent": (
        "{detail}: check the output of {port} with `nc` or `gpspipe`, and who may connect there"
    ),
    # Buses
    "bus_interface": "{detail}: correct interface and channel in [sources.{name}]",
    "bus_missing": (
        "{channel} does not exist: load its driver or correct [sources.{name}]; {others}"
    ),
    "bus_down": (
        "{channel} is down: ip link set {channel} up (add `type can bitrate 250000`, with the "
        "unit's rate, if none is set)"
    ),
    "bus_unusable": "{channel} cannot be used ({detail}): check the interface",
    "bus_silent": (
        "{detail}: check bit rate (ip -d link show {channel}), wiring and power; `candump "
        "{channel}` shows the frames on the bus, [sources.{name}] those required"
    ),
    "bus_silent_elsewhere": (
        "{detail}: check that the unit sends, and that interface and channel in [sources.{name}] "
        "are right"
    ),
    "bus_errors": (
        "{count} CAN error frames: check bit rate, wiring and the two 120 ohm terminators"
    ),
    "bus_overflow": "{count} CAN frames overflowed: reduce the load on this computer",
    "samples_lost": (
        "{lost} of {all} IMU samples lost: check the bus load (canbusload), `ip -s -d link show` "
        "and the load on this computer"
    ),
    "checksums": (
        "{bad} wrong checksums against {good} sound: check ground and cable length, and that no "
        "other program reads this port"
    ),
    # RDSS terminal
    "terminal_silent": (
        "Bytes arrive, but no terminal has answered yet{detail}: listen longer (--seconds 60: "
        "every baud rate is tried), and check this computer's TX to the terminal's RX"
    ),
    "no_card": "{detail}: insert the user card, or have it activated",
    "no_beam": "{detail}: give the antenna a free sky to the south (geostationary satellites)",
    "low_battery": "{detail}: charge the terminal or feed it from the vehicle",
    "suppressed": (
        "{detail}: the RDSS centre suppresses the transmitter: ask the operator of the service"
    ),
    "silence": "{detail}: radio silence is set at the terminal: lift it there",
    # Inertial unit
    "imu_rate": "{seen:.1f} samples a second, but [imu] rate_hz = {set:g}: correct one of them",
    "imu_force": (
        "Specific force at rest is {force:.3f} m/s2 instead of {gravity:.2f}: correct the unit "
        "(accel_unit of [sources.{name}], or the DBC)"
    ),
    "imu_axes": (
        "Gravity lies {tilt:.0f} deg off the body's down axis: the sensor axis that points down is "
        "{down}, so [imu] axes must end with {down!r} (now {axes!r})"
    ),
    "imu_turns": (
        "Gyro reads {rate:.2f} deg/s at rest: warm the unit up, or correct its unit (gyro_unit of "
        "[sources.{name}], or the DBC)"
    ),
    # Receiver, clock, broker
    "fixes_old": (
        "Fixes are up to {age:.1f} s old on arrival: raise the baud rate or switch off sentences "
        "that are not needed (GSV)"
    ),
    "week_rollover": (
        "The receiver's date is {weeks:+d} weeks off the system clock's: its GPS week has rolled "
        "over (1024 weeks): update the receiver; its dates are not used"
    ),
    "system_clock": (
        "The system clock is {error:+.1f} s off GNSS: timedatectl set-ntp true, or chrony with "
        "gpsd; logs and other programs need it, navigation does not"
    ),
    "no_utc": (
        "UTC unknown, as neither system clock nor receiver has it: give the receiver a view of the "
        "sky, or set the clock"
    ),
}


def finding(code: str, **figures: object) -> str:
    """Text of a finding with its figures."""
    return FINDINGS[code].format(**figures)
