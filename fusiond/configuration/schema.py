"""The configuration of a vehicle: one TOML file, in the units that data sheets print.

Every section is a frozen pydantic model that refuses unknown keys. Units stand in the names;
nothing else in the project converts them: `fusiond.configuration.si_units` turns this into SI once.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    NonNegativeFloat,
    PositiveFloat,
    PositiveInt,
    model_validator,
)

from fusiond.configuration.aiding import (
    AIDING_KINDS,
    AnyAiding,
    GnssAiding,
    Probability,
    RawAiding,
    RdssAiding,
    Section,
    Vector,
)
from fusiond.configuration.alignment import Alignment
from fusiond.configuration.constraints import Constraints
from fusiond.configuration.estimator import Estimator
from fusiond.configuration.integrity import Integrity
from fusiond.configuration.outputs import Host, Outputs, Port
from fusiond.configuration.position_reports import PositionReports
from fusiond.configuration.recording import Recording
from fusiond.configuration.sensor_class import CLASSES, SensorClass
from fusiond.configuration.vehicle_class import PLAUSIBILITY, Plausibility, VehicleClass


def _right_handed(axes: tuple[str, str, str]) -> tuple[str, str, str]:
    letters = [a[-1] for a in axes]
    if sorted(letters) != ["x", "y", "z"]:
        raise ValueError("name each of x, y and z once, such as ['-x', '+y', '-z']")
    even = letters in (["x", "y", "z"], ["y", "z", "x"], ["z", "x", "y"])
    negative = sum(a.startswith("-") for a in axes)
    if (negative % 2 == 0) != even:
        raise ValueError("these axes are left-handed: change one sign")
    return axes


Axis = Annotated[str, Field(pattern=r"^[+-]?[xyz]$")]
Axes = Annotated[tuple[Axis, Axis, Axis], AfterValidator(_right_handed)]


class SpareImu(Section):
    """A second inertial unit of the same kind, which takes over when the first one fails."""

    source: str
    """Name of the spare's `[sources.NAME]`."""
    axes: Axes = ("+x", "+y", "+z")
    """Its sensor axes along body forward, right and down."""
    mounting_deg: Vector = (0.0, 0.0, 0.0)
    """Roll, pitch, yaw of its nominal sensor frame against the body."""
    mounting_sd_deg: PositiveFloat = 1.0
    """One sigma of each of those angles, relative to the first unit."""

    @property
    def mounted(self) -> dict[str, Any]:
        """Orientation of the sensor, by the keys of `[imu]`."""
        return {"axes": self.axes, "mounting_deg": self.mounting_deg}


class Imu(Section):
    """Inertial sensor: mounting and error model.

    `axes` names the sensor axis that points along body forward, right and down;
    `mounting_deg` is the small rest, roll, pitch, yaw from body to those nominal axes.
    """

    sensor_class: SensorClass | None = None
    """`consumer`, `mems` or `tactical`: gives noise, biases and scale factors for keys that are not
    set; see `docs/vehicle.md`."""
    axes: Axes = ("+x", "+y", "+z")
    """Sensor axes along body forward, right and down."""
    mounting_deg: Vector = (0.0, 0.0, 0.0)
    """Roll, pitch, yaw of the nominal sensor frame against the body."""
    time_offset_s: float = 0.0
    """Added to the sensor's stamps; negative if the stamps are late."""
    rate_hz: PositiveFloat = 100.0
    gyro_range_deg_s: PositiveFloat | None = None
    """Full scale of the data sheet: a rate that reaches it is rejected as `saturated`."""
    accel_range_g: PositiveFloat | None = None
    """Full scale of specific force."""
    gyro_noise_deg_sqrt_h: PositiveFloat = 0.3
    """Angle random walk."""
    accel_noise_m_s_sqrt_h: PositiveFloat = 0.1
    """Velocity random walk."""
    gyro_bias_instability_deg_h: PositiveFloat = 10.0
    """One sigma of the drifting part of the bias."""
    accel_bias_instability_mg: PositiveFloat = 0.1
    """One sigma of the drifting part of the bias."""
    bias_correlation_s: PositiveFloat = 3600.0
    """Correlation time of that error."""
    gyro_bias_initial_deg_h: PositiveFloat = 360.0
    """One sigma of the bias at switch-on."""
    accel_bias_initial_mg: PositiveFloat = 10.0
    """One sigma of the bias at switch-on."""
    gyro_scale_ppm: PositiveFloat = 2000.0
    """One sigma of the scale factors' errors."""
    accel_scale_ppm: PositiveFloat = 2000.0
    """One sigma of the scale factors' errors."""
    misalignment_deg: NonNegativeFloat = 0.0
    """One sigma of each small angle by which an axis is out of square: cross-axis sensitivity, 1 %
    of it is 0.57 deg. It is noise while the vehicle turns."""
    gap_s: PositiveFloat = 0.5
    """A longer pause between samples is a gap, which the mode reports. The covariance grows in any
    pause longer than 3.5 samples."""
    spare: SpareImu | None = None
    """`[imu.spare]`: a second unit; see `docs/can-imu.md`."""

    @model_validator(mode="before")
    @classmethod
    def _of_its_class(cls, data: Any) -> Any:
        """Values of the class for keys that are absent."""
        named = data.get("sensor_class") if isinstance(data, dict) else None
        known = CLASSES.get(named) if named is not None else None
        return {**known, **data} if known else data


class ConsistencyTest(Section):
    """The verdict on a source's innovations; see `docs/consistency.md`."""

    window: Annotated[int, Field(ge=20, le=10000)] = 100
    """Number of epochs of a test. RDSS sources, with a fix a minute, use half."""
    alpha: Probability = 0.01
    """Share of windows of a matched filter that are found wrong by chance."""


class Scheduler(Section):
    rate_hz: Annotated[float, Field(ge=1.0, le=1000.0)] = 100.0


class ClockOptions(Section):
    """Source of UTC.

    `gnss`: the receiver's time, as the lower envelope of arrival minus `serial_latency_s`, and the
    system clock until that is known. `system`: always CLOCK_REALTIME (NTP or PPS keeps it); a step
    of it moves measurements only after two minutes, and sigma knows it meanwhile.
    """

    utc: Literal["gnss", "system"] = "gnss"
    serial_latency_s: NonNegativeFloat = 0.05
    """Least time between a receiver's epoch and the last byte of its sentences."""
    rdss_latency_s: PositiveFloat = 0.8
    """Assumed age of an RDSS fix whose time of day fits no candidate."""
    max_clock_drift_ppm: PositiveFloat = 100.0


CommandName = Literal[
    "set_position",
    "request_fix",
    "send_message",
    "reset_filter",
    "start_recording",
    "stop_recording",
    "inject",
]


class Mqtt(Section):
    """Broker. Passwords come from FUSIOND_MQTT_PASSWORD or from `password_file`, never from
    here."""

    enabled: bool = True
    host: Host = "localhost"
    port: Port = 1883
    client_id: str | None = None
    username: str | None = None
    password_file: Path | None = None
    tls: bool = False
    ca_file: Path | None = None
    cert_file: Path | None = None
    key_file: Path | None = None
    keepalive_s: PositiveInt = 20
    nav_rate_hz: Annotated[float, Field(ge=1.0, le=100.0)] = 10.0
    health_rate_hz: Annotated[float, Field(ge=0.1, le=10.0)] = 1.0
    queue: Annotated[int, Field(ge=1, le=10000)] = 64
    """Most messages that wait for the broker; then the oldest is dropped and counted."""
    commands: tuple[CommandName, ...] = ()
    """Commands accepted on `cmd/<name>`; none by default."""


class Source(BaseModel):
    """Device: its driver, and the driver's options as further keys."""

    model_config = ConfigDict(extra="allow", frozen=True, defer_build=True)
    driver: str

    @property
    def options(self) -> dict[str, Any]:
        return dict(self.model_extra or {})


class Config(Section):
    """A vehicle. `sources` are devices, `aiding` their use in the filter."""

    vehicle: Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]{1,64}$")] = "vehicle"
    vehicle_class: VehicleClass = "road"
    """Class of the vehicle: height and speed of no measurement may exceed what its class can do."""
    state_file: Path | None = None
    """Path of the last solution for the next start; the unit's state directory by default."""
    log_level: Literal["debug", "info", "warning", "error"] = "info"
    """Least level of messages in the log."""
    imu: Imu = Field(default_factory=Imu.unsaid)
    sources: dict[str, Source] = Field(default_factory=dict)
    aiding: dict[str, AnyAiding] = Field(default_factory=dict)
    constraints: Constraints = Field(default_factory=Constraints.unsaid)
    alignment: Alignment = Field(default_factory=Alignment.unsaid)
    estimator: Estimator = Field(default_factory=Estimator.unsaid)
    consistency: ConsistencyTest = Field(default_factory=ConsistencyTest.unsaid)
    integrity: Integrity = Field(default_factory=Integrity.unsaid)
    scheduler: Scheduler = Field(default_factory=Scheduler.unsaid)
    clock: ClockOptions = Field(default_factory=ClockOptions.unsaid)
    mqtt: Mqtt = Field(default_factory=Mqtt.unsaid)
    position_reports: PositionReports = Field(default_factory=PositionReports.unsaid)
    recording: Recording = Field(default_factory=Recording.unsaid)
    outputs: Outputs = Field(default_factory=Outputs.unsaid)

    @property
    def plausibility(self) -> Plausibility:
        """Limits of a vehicle of this class."""
        return PLAUSIBILITY[self.vehicle_class]

    @model_validator(mode="before")
    @classmethod
    def _kind_from_name(cls, data: Any) -> Any:
        """Derive `kind` from the name: `[aiding.gnss]` needs none."""
        if isinstance(data, dict) and isinstance(data.get("aiding"), dict):
            aiding = {
                name: {"kind": name, **value}
                if isinstance(value, dict) and name in AIDING_KINDS
                else value
                for name, value in data["aiding"].items()
            }
            data = {**data, "aiding": aiding}
        return data

    @model_validator(mode="after")
    def _broker_for_what_needs_it(self) -> Config:
        if self.outputs.through_the_broker and not self.mqtt.enabled:
            raise ValueError(f"[outputs.{self.outputs.through_the_broker[0]}] needs [mqtt] enabled")
        return self

    @model_validator(mode="after")
    def _chrony_has_another_clock(self) -> Config:
        if self.outputs.chrony is not None and self.clock.utc == "system":
            raise ValueError(
                "[outputs.chrony] with clock.utc 'system' would set the system clock by itself"
            )
        return self

    @model_validator(mode="after")
    def _one_raw_receiver(self) -> Config:
        raw = [name for name, section in self.aiding.items() if isinstance(section, RawAiding)]
        if len(raw) > 1:
            raise ValueError(f"{' and '.join(raw)}: keep one source of raw data, with one clock")
        return self

    @model_validator(mode="after")
    def _reports_have_a_terminal(self) -> Config:
        o = self.position_reports
        if o.card is None:
            return self
        terminals = [name for name, source in self.sources.items() if source.driver == "rdss"]
        if not terminals:
            raise ValueError("position_reports.card needs a source with driver 'rdss'")
        if o.source is None and len(terminals) > 1:
            raise ValueError(f"position_reports.source: name one of {', '.join(terminals)}")
        if o.source is not None and o.source not in terminals:
            raise ValueError(
                f"position_reports.source: no terminal {o.source!r}; name one of "
                f"{', '.join(terminals)}"
            )
        return self

    @property
    def positioning(self) -> tuple[str, ...]:
        """The sections of aiding that give positions."""
        kinds = GnssAiding | RawAiding | RdssAiding
        return tuple(name for name, section in self.aiding.items() if isinstance(section, kinds))

    @model_validator(mode="after")
    def _levels_can_be_computed(self) -> Config:
        o = self.integrity
        unknown = [name for name in o.fault_probability_per_hour if name not in self.positioning]
        if unknown:
            raise ValueError(
                f"integrity.fault_probability_per_hour: no [aiding.{unknown[0]}] with positions"
            )
        if not o.watched:
            return self
        if self.estimator.filter != "kalman":
            raise ValueError("[integrity] needs estimator.filter 'kalman'")
        if not self.positioning:
            raise ValueError("[integrity] needs a section [aiding.NAME] that gives positions")
        return self

    @model_validator(mode="after")
    def _local_filters_exist(self) -> Config:
        if self.estimator.filter != "federated":
            return self
        federated = self.estimator.federated
        names = federated.sources or tuple(self.aiding)
        if not names:
            raise ValueError("estimator.filter 'federated' needs [aiding.NAME] for each source")
        unknown = [name for name in names if name not in self.aiding]
        if unknown:
            raise ValueError(f"estimator.federated.sources: no [aiding.{unknown[0]}]")
        if federated.shares and set(federated.shares) != set(names):
            raise ValueError(
                "estimator.federated.shares must name every local filter and nothing else"
            )
        return self
