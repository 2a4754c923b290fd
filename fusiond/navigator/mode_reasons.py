"""Catalogue of the reasons that `why` gives: text, weight and next step of each.

`reason(code, ...)` is the only way to a sentence of `why`; several are joined by `JOIN`.
`recognised` finds the entries of a `why` that came over a topic. docs/troubleshooting.md lists all.
The order is that of urgency: the first entry that is recognised names the step to take first.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from functools import cache
from typing import Literal, NamedTuple

Weight = Literal["error", "warning", "info"]
JOIN = "; "


class Reason(NamedTuple):
    """Reason of a mode: a template of its text, and the operator's next step."""

    weight: Weight
    text: str
    advice: str = ""


IMU: Mapping[str, Reason] = {
    "no_imu": Reason("error", "Waiting for IMU data", "Check power and bus of the IMU."),
    "imu_silent": Reason(
        "error", "IMU silent for {seconds:.1f} s", "Check power and bus of the IMU."
    ),
    "imu_stamps_back": Reason(
        "warning", "IMU stamps went back: aligning again", "Check the clock of the IMU."
    ),
    "heading_lost": Reason(
        "warning",
        "Heading known to {sd:.0f} deg only: aligning again",
        "Drive on where there are fixes.",
    ),
    "imu_stamps_ahead": Reason(
        "warning",
        "IMU stamps lie ahead of what arrives: aligning again",
        "Check the clock of the IMU.",
    ),
    "imu_was_silent": Reason(
        "warning", "IMU was silent too long: aligning again", "Check power and bus of the IMU."
    ),
    "imu_axis_dead": Reason(
        "error", "One IMU axis stands still: aligning again", "Check the DBC; replace the IMU."
    ),
    "imu_spare": Reason("warning", "The spare IMU is used: aligning again", "Check the first IMU."),
    "imu_upside_down": Reason(
        "error",
        "IMU upside down: gravity points up. Correct [imu] axes",
        "Correct `axes` in [imu], then restart.",
    ),
    "imu_backwards": Reason(
        "error",
        "Driving backward at {speed:.0f} m/s: IMU mounted backwards? Correct [imu] axes",
        "Correct `axes` in [imu], then restart.",
    ),
    "imu_backwards_by_fixes": Reason(
        "error",
        "Fixes move backward too fast: IMU mounted backwards? Correct [imu] axes",
        "Correct `axes` in [imu], then restart.",
    ),
    "imu_sideways": Reason(
        "error",
        "Sideways start sensed: check [imu] axes",
        "Correct `axes` in [imu], then restart.",
    ),
    "force_unit": Reason(
        "error",
        "Specific force is {size:.4g} at the median, gravity is 9.81 m/s^2: it looks like {unit}; "
        "multiply the accelerometer's figures by {factor:g}",
        "Correct the unit of the accelerometer, then restart.",
    ),
    "force_unknown": Reason(
        "error",
        "Specific force is {size:.4g} at the median, gravity is 9.81 m/s^2: another unit, or "
        "gravity removed",
        "Have the IMU send specific force in m/s^2.",
    ),
    "rate_size": Reason(
        "error",
        "Rates of {size:.3g} rad/s RMS exceed a vehicle's: they look like deg/s; multiply the "
        "gyro's figures by pi/180",
        "Correct the unit of the gyro, then restart.",
    ),
    "rate_turns": Reason(
        "error",
        "Rates are {factor:.0f} times the turns of the course: they look like deg/s; multiply the "
        "gyro's figures by pi/180",
        "Correct the unit of the gyro, then restart.",
    ),
    "rate_path": Reason(
        "error",
        "Rates disagree with the path between fixes: they look like deg/s; multiply the gyro's "
        "figures by pi/180",
        "Correct the unit of the gyro, then restart.",
    ),
    "bias_size": Reason(
        "warning",
        "{sensor} bias of {size:.2g} {unit} is {sigmas:.0f} sigma of [imu]: another unit or sensor",
        "Take some bends; if it stays, correct [imu].",
    ),
    "imu_rate": Reason(
        "warning",
        "Samples come at {seen:.0f} Hz, the configuration says {configured:g}: correct imu.rate_hz",
        "Correct `imu.rate_hz` in the configuration.",
    ),
}

ALIGNING: Mapping[str, Reason] = {
    "no_position": Reason(
        "warning",
        "Waiting for a first position fix",
        "Give a receiver a view of the sky, or use `set_position`.",
    ),
    "fixes_delayed": Reason(
        "info",
        "{source} is about {seconds:.1f} s late: brake, accelerate or turn to measure it",
        "Brake, accelerate or take a bend.",
    ),
    "parked_elsewhere": Reason(
        "info",
        "The fix is {distance:.0f} m from the parking place: moved while off, heading not used",
        "Drive straight on.",
    ),
    "saved_moved": Reason(
        "info", "Vehicle moved: the saved heading no longer counts", "Drive straight on."
    ),
    "configured_moved": Reason(
        "info", "Vehicle moved: the configured heading no longer counts", "Drive straight on."
    ),
    "poor_heading": Reason(
        "info",
        "The {heading} is only known to {sd:.0f} deg: drive off to measure it",
        "Drive straight on.",
    ),
    "shaken": Reason(
        "info",
        "Shaken by {rate:.2g} deg/s and {force:.2g} m/s^2; rest is below {rate_limit:.2g} and "
        "{force_limit:.2g} ([constraints.zero_velocity])",
        "Set its thresholds to twice what doctor shows with the engine on.",
    ),
    "levelling": Reason(
        "info", "At rest for {seconds:.0f} s of the {needed:g} that levelling needs", "Stand still."
    ),
    "levelling_moved": Reason(
        "info",
        "At rest for {seconds:.0f} s of the {needed:g} that levelling needs, then moved",
        "Stand still, or drive on: fixes level it.",
    ),
    "turning": Reason(
        "info",
        "Turning at {rate:.2f} deg/s: not at rest, or gyro bias above gyro_bias_initial_deg_h",
        "Warm the IMU up; check the unit of its gyro.",
    ),
    "no_level": Reason(
        "info", "No level: stand still, or drive with fixes", "Stand still until it is level."
    ),
    "gyrocompassing": Reason(
        "info",
        "At rest for {seconds:.0f} s of the {needed:g} that gyrocompassing needs",
        "Stand still with the engine off.",
    ),
    "gyrocompassing_moved": Reason(
        "info",
        "At rest for {seconds:.0f} s of the {needed:g} that gyrocompassing needs, then moved",
        "Stand still with the engine off.",
    ),
    "gyrocompass_stand": Reason(
        "info",
        "Stand still for {seconds:g} s to gyrocompass",
        "Stand still with the engine off.",
    ),
    "gyrocompass_poor": Reason(
        "info",
        "Gyro of {bias:.3g} deg/h cannot gyrocompass: {limit:.2g} deg take {needed:.2g} deg/h",
        "Allow `gnss_course` in `alignment.heading`.",
    ),
    "heading_old": Reason(
        "info",
        "The last two-antenna heading is {seconds:.0f} s old",
        "Check the antennas; HDT or THS must be on.",
    ),
    "no_two_antennas": Reason(
        "info",
        "No two-antenna heading received",
        "Switch on HDT or THS, or allow other sources.",
    ),
    "no_compass": Reason(
        "info", "No compass heading received", "Switch on HDG or HDM, or allow other sources."
    ),
    "no_velocity": Reason(
        "info",
        "No velocity received for a course",
        "Switch on RMC or VTG; or drive on with `positions` allowed.",
    ),
    "confirming_course": Reason(
        "info", "Checking the velocity against the positions: drive on", "Drive straight on."
    ),
    "reversing": Reason("info", "Moving off backward: waiting for a steady speed", "Drive on."),
    "collecting": Reason("info", "Moving: collecting fixes", "Drive straight on."),
    "fixes_disagree": Reason(
        "info",
        "Velocities of the fixes disagree with the IMU",
        "Drive on; if it stays, check [imu] axes and units.",
    ),
    "no_attitude": Reason("info", "Moving: no attitude fits the IMU yet", "Drive straight on."),
    "direction": Reason(
        "info",
        "Forward or backward? Brake, accelerate or turn (forward is assumed after {seconds:.0f} s)",
        "Brake, accelerate or take a bend.",
    ),
    "no_path": Reason("info", "Drive off, with bends: fixes give the heading", "Drive off."),
    "searching_again": Reason("info", "Fixes fit no heading: searching again", "Drive on."),
    "searching": Reason(
        "info",
        "Finding the heading: {sd:.0f} deg from {fixes} fixes, {limit:.0f} deg and {least} fixes "
        "needed; drive on",
        "Drive on, with bends.",
    ),
    "searching_speed": Reason(
        "info",
        "Heading found, speed known to {sd:.1f} m/s, {limit:.1f} needed; drive on",
        "Drive on.",
    ),
    "no_heading_course": Reason(
        "info", "No heading: drive straight above {speed:g} m/s", "Drive straight on."
    ),
    "no_heading_path": Reason("info", "No heading: drive off, with bends", "Drive off."),
    "no_heading_rest": Reason("info", "No heading: stand still, engine off", "Stand still."),
    "no_heading": Reason(
        "info",
        "No heading: waiting for {sources}",
        "Check that device; or allow `gnss_course` in `alignment.heading`.",
    ),
    "allowed": Reason("info", "allowed: {sources}"),
}

STARTING: Mapping[str, Reason] = {
    "compiling": Reason(
        "info", "compiling {done}/{total} kernels, once", "Wait: it is done once for each version."
    ),
}

SOLUTION: Mapping[str, Reason] = {
    "sigma": Reason(
        "error",
        "Horizontal sigma {sd:.0f} m, limit {limit:g} m",
        "Get a receiver back, or use `set_position`.",
    ),
    "too_fast": Reason(
        "error",
        "{speed:.0f} m/s is faster than this vehicle can be",
        "Check `vehicle_class` and the sensors.",
    ),
    "filter_disagrees": Reason(
        "error",
        "Positions and velocities of {device} agree, the filter disagrees",
        "If it repeats: check axes, lever arms, `mounting_deg`.",
    ),
    "nothing_in_service": Reason(
        "error",
        "No position in service, and sigma is beyond its limit",
        "See `diagnosis` of the receivers.",
    ),
    "not_confirmed_by_fix": Reason("info", "not confirmed by a fix yet", "Wait for a fix."),
    "not_confirmed_by_motion": Reason(
        "info", "not confirmed by motion yet", "Drive straight above 3 m/s."
    ),
    "backward_or_mounted": Reason(
        "info",
        "driving backward, or the IMU is mounted backwards",
        "Drive forward; if it stays, correct `axes` in [imu].",
    ),
    "no_fix": Reason(
        "warning",
        "No position fused for {seconds:.0f} s",
        "Get a receiver back; meanwhile sigma grows.",
    ),
    "by_fixes_alone": Reason(
        "info",
        "No inertial unit: constant velocity, no attitude",
        "Check power and bus of the IMU, if there is one.",
    ),
    "heading_from": Reason("info", "Heading from {how}"),
    "fixes_back": Reason("info", "Position fixes of {source} are back"),
    "calibration_wrong": Reason(
        "warning",
        "The saved calibration is wrong: {what}",
        "If it repeats, check the IMU's mounting.",
    ),
    "warm_start_wrong": Reason(
        "warning", "{source} contradicts the state of the last run", "Wait: alignment runs again."
    ),
    "before_history": Reason("info", "Before the stored history", "Ask for a later instant."),
}

REASONS: Mapping[str, Reason] = {**STARTING, **IMU, **ALIGNING, **SOLUTION}


def reason(code: str, **figures: object) -> str:
    """Text of a reason with its figures."""
    return REASONS[code].text.format(**figures)


def joined(parts: Iterable[str]) -> str:
    """Sentence of several reasons, each once; the first keeps its capital."""
    first, *others = dict.fromkeys(parts)
    return JOIN.join((first, *map(_continued, others)))


def _continued(text: str) -> str:
    """Text after a semicolon: an abbreviation such as IMU keeps its capitals."""
    return text[0].lower() + text[1:] if text[1:2].islower() or text[1:2] == " " else text


def recognised(why: str) -> list[str]:
    """Codes of the reasons in `why`, the most urgent first."""
    return [code for code, pattern in _patterns().items() if pattern.search(why)]


@cache
def _patterns() -> dict[str, re.Pattern[str]]:
    return {code: re.compile(_pattern(r.text), re.IGNORECASE) for code, r in REASONS.items()}


def _pattern(text: str) -> str:
    """A regular expression of a template: figures are anything short."""
    literals = re.split(r"\{[^}]*\}", text)
    return "[^;]{1,40}?".join(map(re.escape, literals))
