"""Command config: a first configuration from devices found and questions answered."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_args

import typer

from fusiond.commands.shared import EXIT_IO, config_errors, parse_mqtt, spinner

if TYPE_CHECKING:
    from drivers.can.bus import Interface
    from fusiond.configuration.draft import Draft, DraftSource, Vector
    from fusiond.doctor.discovery import Device, SilentPort
    from fusiond.doctor.forward_axis import Phase

config = typer.Typer(no_args_is_help=True, help="Configurations: write a first one.")
_NAMES = {"can_imu": "imu", "compass": "compass", "rdss": "rdss"}
_RECEIVER = "gnss"
"""Name of every other device that is recognised: a receiver, whatever it speaks."""
ARM = typer.Option(metavar="F,R,D", help="m forward, right, down of the IMU.")
Out = Annotated[Path, typer.Argument(metavar="CONFIG", help="File to write.")]
VehicleClassName = Annotated[
    str | None, typer.Option("--class", help="road, rail, marine or aircraft.")
]
SensorClassName = Annotated[
    str | None, typer.Option(help="Of the IMU: consumer, mems or tactical.")
]
AxesText = Annotated[
    str | None,
    typer.Option(metavar="X,Y,Z", help="Sensor axes forward, right, down: +x,-y,-z."),
]
Ports = Annotated[list[str] | None, typer.Option(help="Serial port to listen to; all by default.")]
Buses = Annotated[
    list[str] | None,
    typer.Option(metavar="[INTERFACE:]CHANNEL", help="CAN bus; all that are up by default."),
]
AskTerminal = Annotated[
    bool | None,
    typer.Option(
        "--ask-terminal/--listen-only",
        help="Query silent ports, to find an RDSS terminal; it transmits nothing.",
    ),
]
Drive = Annotated[
    bool | None,
    typer.Option(
        "--drive/--no-drive", help="Find the IMU's forward axis by driving off straight ahead."
    ),
]


@config.command()
def init(
    out: Out = Path("vehicle.toml"),
    vehicle: Annotated[str | None, typer.Option(help="Its name, as in the MQTT topics.")] = None,
    vehicle_class: VehicleClassName = None,
    sensor_class: SensorClassName = None,
    axes: AxesText = None,
    antenna: Annotated[str | None, ARM] = None,
    axle: Annotated[str | None, ARM] = None,
    broker: Annotated[str | None, typer.Option(metavar="HOST[:PORT]", help="MQTT.")] = None,
    port: Ports = None,
    can: Buses = None,
    ask_terminal: AskTerminal = None,
    drive: Drive = None,
    yes: Annotated[
        bool, typer.Option("--yes", help="Use defaults and options, without questions.")
    ] = False,
    force: Annotated[bool, typer.Option("--force", help="Overwrite the file.")] = False,
) -> None:
    """Write a first configuration from the devices it finds.

    It looks at ports and buses, and asks for the rest.

    Nothing is sent to a device unless --ask-terminal (or your answer) allows it. The file is
    commented and passes `fusiond check`, whose doubts are printed.
    """
    from fusiond.configuration.draft import Draft  # noqa: PLC0415
    from fusiond.configuration.sensor_class import SensorClass  # noqa: PLC0415
    from fusiond.configuration.vehicle_class import VehicleClass  # noqa: PLC0415

    if out.exists() and not force:
        raise typer.BadParameter(f"{out} exists: --force overwrites it")
    asks = not yes and sys.stdin.isatty()

    def answer(given: str | None, question: str, default: str) -> str:
        if given is not None:
            return given
        return str(typer.prompt(question, default=default)) if asks else default

    if ask_terminal is None:
        question = "Ask silent serial ports whether an RDSS terminal is there (sends bytes)?"
        ask_terminal = asks and typer.confirm(question, default=False)
    devices = _found(port, can, ask_terminal)
    imu = next((d for d in devices if d.driver == "can_imu"), None)
    has_antenna = any(d.driver != "can_imu" for d in devices)
    where = ""
    if has_antenna or antenna is not None:
        question = "GNSS antenna from the IMU, m forward,right,down (empty: later)"
        where = answer(antenna, question, "")
    arms = {} if not where else dict.fromkeys(("gnss", "rdss"), _vector(where))
    forward = None
    if axes is None and imu is not None and imu.down is not None:
        question = "Drive off straight ahead now, to find the IMU's forward axis?"
        if drive or (drive is None and asks and typer.confirm(question, default=False)):
            forward = _driven_axis(imu, imu.down)
    measured, known = _measured_axes(imu, forward)
    if axes is None and imu is not None:
        typer.echo(f"axes: {known}")
    kind = _choice(answer(vehicle_class, "Vehicle class", "road"), VehicleClass)
    rear = answer(axle, "Rear axle from the IMU, m forward,right,down (empty: later)", "")
    draft = Draft(
        vehicle=answer(vehicle, "Name of the vehicle", "vehicle"),
        vehicle_class=kind,
        sensor_class=_choice(answer(sensor_class, "Class of the IMU", "mems"), SensorClass),
        axes=_axes(answer(axes, "IMU axes forward,right,down", ",".join(measured))),
        axes_known=known if axes is None else "",
        rate_hz=100.0 if imu is None or imu.rate_hz is None else imu.rate_hz,
        lever_arms_m=arms,
        axle_m=_vector(rear) if rear else None,
        broker=parse_mqtt(answer(broker, "MQTT broker", "localhost:1883")),
        sources=_sources(devices),
    )
    _write(draft, out)


def _found(port: list[str] | None, can: list[str] | None, ask_terminal: bool) -> list[Device]:
    """Look for devices, and print what was found."""
    devices, silent = _look(port, can, ask_terminal)
    for device in devices:
        typer.echo(f"found: {device.text}")
    for one in silent:
        typer.echo(f"found nothing: {one.text}")
    if not devices:
        looked_at = ", ".join([*(port or ()), *(can or ())]) or "serial ports and CAN buses"
        typer.echo(f"No supported device found on: {looked_at}")
    return devices


def _measured_axes(
    imu: Device | None, forward: str | None = None
) -> tuple[tuple[str, str, str], str]:
    """Sensor axes with down by gravity, and a sentence on their origin. Without `forward`, which a
    drive shows, the first level axis is assumed."""
    from fusiond.doctor.forward_axis import axes_of  # noqa: PLC0415

    if imu is None or imu.down is None:
        level = "the unit moved or stands askew" if imu is not None else "no unit was heard"
        return ("+x", "+y", "+z"), f"Not measured ({level}): `fusiond doctor` at rest says down."
    if forward is not None:
        return axes_of(forward, imu.down), (
            f"Down is {imu.down}, by gravity; {forward} is forward, by driving off."
        )
    level_axis = "+" + next(axis for axis in "xyz" if axis != imu.down[1])
    return axes_of(level_axis, imu.down), (
        f"Down is {imu.down}, by gravity. That {level_axis} points forward is assumed: look at the "
        "unit's mark, or use `fusiond config init --drive`."
    )


def _driven_axis(imu: Device, down: str) -> str | None:
    """Forward axis of the unit by a short drive; None, with the reason printed, without one."""
    import asyncio  # noqa: PLC0415

    from drivers.can.imu import CanImuOptions  # noqa: PLC0415
    from fusiond.doctor.forward_axis import DRIVE_S, watch_departure  # noqa: PLC0415

    advice = {
        "standing": "standing: now drive off straight ahead, faster than walking pace",
        "moving": "moving",
    }

    def on_phase(phase: Phase) -> None:
        if phase in advice:
            typer.echo(advice[phase])

    typer.echo("stand still for two seconds")
    options = CanImuOptions.model_validate(imu.options)
    found = asyncio.run(watch_departure(options, down, DRIVE_S, on_phase))
    if found.axis is None:
        typer.echo(f"forward axis not found: {found.reason}; try again, or give --axes")
    return found.axis


def _look(
    ports: list[str] | None, buses: list[str] | None, ask_terminal: bool
) -> tuple[list[Device], list[SilentPort]]:
    """Devices on buses, then on ports; and the buses and the named ports without one."""
    import asyncio  # noqa: PLC0415

    from fusiond.doctor.devices import can_interfaces, similar_ports  # noqa: PLC0415
    from fusiond.doctor.discovery import Device, SilentPort, device_on_bus, device_on_port  # noqa: PLC0415

    channels = [_bus(text) for text in (can_interfaces() if buses is None else buses)]

    # A port that has a lasting name as well is known by that, which comes first.
    lines = similar_ports() if ports is None else ports
    unique = {Path(line).resolve(): line for line in reversed(lines)}

    async def look() -> tuple[list[Device], list[SilentPort]]:
        found = await asyncio.gather(
            *(device_on_port(line, ask_terminal=ask_terminal) for line in unique.values())
        )
        on_buses = await asyncio.gather(*(device_on_bus(*channel) for channel in channels))
        looked_at = [one for bus in on_buses for one in bus]
        looked_at += [one for one in found if ports is not None or isinstance(one, Device)]
        devices = [one for one in looked_at if isinstance(one, Device)]
        return devices, [one for one in looked_at if isinstance(one, SilentPort)]

    with spinner("listening to ports and buses"):
        return asyncio.run(look())


def _bus(text: str) -> tuple[Interface, str]:
    from drivers.can.bus import Interface  # noqa: PLC0415

    interface, colon, channel = text.partition(":")
    if not colon:
        return "socketcan", text
    return _choice(interface, Interface), channel


def _sources(devices: list[Device]) -> list[DraftSource]:
    """Sections of the sources, named after their kind, numbered where there are several; only the
    first IMU."""
    from fusiond.configuration.draft import DraftSource  # noqa: PLC0415

    sources: dict[str, DraftSource] = {}
    raw = False
    for device in devices:
        name = base = _NAMES.get(device.driver, _RECEIVER)
        if base == "imu" and base in sources:
            continue
        number = 1
        while name in sources:
            number += 1
            name = f"{base}{number}"
        options, driver = dict(device.options), device.driver
        if driver == "gnss" and raw:
            driver = "nmea"  # one receiver's raw data at most
        raw |= driver == "gnss"
        sources[name] = DraftSource(name, driver, options, device.text, device.aiding)
    return list(sources.values())


def _write(draft: Draft, out: Path) -> None:
    """Write the configuration file after validating it."""
    from tempfile import TemporaryDirectory  # noqa: PLC0415

    from fusiond.configuration.doubts import doubts  # noqa: PLC0415
    from fusiond.configuration.draft import toml  # noqa: PLC0415
    from fusiond.configuration.load import load_config  # noqa: PLC0415

    text = toml(draft)
    with TemporaryDirectory(prefix="fusiond-") as folder, config_errors():
        trial = Path(folder) / out.name
        trial.write_text(text, encoding="utf-8")
        settings = load_config(trial)
    try:
        out.write_text(text, encoding="utf-8")
    except OSError as error:
        typer.echo(f"fusiond: {out}: {error.strerror}", err=True)
        raise typer.Exit(EXIT_IO) from error
    typer.echo(f"{out}: written; go on with `fusiond check {out}` and `fusiond doctor {out}`")
    for doubt in doubts(settings):
        typer.echo(f"  ! {doubt}")


def _choice(text: str, literal: Any) -> Any:
    allowed = get_args(literal)
    if text not in allowed:
        raise typer.BadParameter(f"{text!r}: one of {', '.join(allowed)}")
    return text


def _vector(text: str) -> Vector:
    parts = text.split(",")
    try:
        x, y, z = (float(part) for part in parts)
    except ValueError as error:
        raise typer.BadParameter(f"{text!r}: three numbers, forward,right,down in m") from error
    return x, y, z


def _axes(text: str) -> tuple[str, str, str]:
    parts = tuple(part.strip() for part in text.split(","))
    if len(parts) != 3:
        raise typer.BadParameter(f"{text!r}: three axes such as +x,-y,-z")
    return parts
