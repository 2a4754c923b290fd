"""Catalogue of events: level, meaning and next step of each code.

`EVENTS` names every code that drivers, navigator, outputs and daemon report; docs/events.md lists
them. A driver from another package may report a code of its own, which is information without a
next step.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal, NamedTuple

Level = Literal["info", "warning", "error"]


class Entry(NamedTuple):
    """Event code; `advice` is the operator's next step, empty if none is needed."""

    level: Level
    meaning: str
    advice: str = ""


def info(meaning: str, advice: str = "") -> Entry:
    """Entry of a normal event, or of one that needs no action soon."""
    return Entry("info", meaning, advice)


def warning(meaning: str, advice: str) -> Entry:
    """Entry of an event that makes the solution worse, or soon will."""
    return Entry("warning", meaning, advice)


def error(meaning: str, advice: str) -> Entry:
    """Entry of a failure that the operator must repair."""
    return Entry("error", meaning, advice)


BUG = "Report the text of the event as a bug."
WIRING = "Check power, cable and port; `fusiond doctor` shows what arrives."
DISK = "Check free space and permissions of the directory."

DEVICES: Mapping[str, Entry] = {
    "device_absent": warning("A port cannot be opened; the driver retries.", WIRING),
    "device_silent": warning("A port is open and brings nothing usable.", WIRING),
    "device_running": info("A device sends measurements."),
    "device_failed": error(
        "A device cannot work as configured.", "Correct its section, then restart."
    ),
    "device_restarted": info(
        "A device's clock started again.", "Check its power supply if this repeats."
    ),
    "driver_fault": error("A driver failed and was restarted.", BUG),
    "interface_up": info("A CAN interface is back."),
    "interface_down": warning(
        "A CAN interface is down or does not exist.", "Run `ip link set can0 up`."
    ),
    "bus_off": error(
        "The CAN controller left the bus.",
        "Check wiring, termination and bit rate; set `restart-ms`.",
    ),
    "error_passive": warning(
        "The CAN controller sees many errors.", "Check wiring and termination."
    ),
    "error_warning": warning("The CAN controller counts errors.", "Check wiring and termination."),
    "error_active": info("The CAN controller works normally again."),
    "ntrip_starting": info("The NTRIP client connects."),
    "ntrip_waiting": info("The caster needs a position of the receiver."),
    "ntrip_running": info("Corrections arrive from the NTRIP caster."),
    "ntrip_lost": warning(
        "Corrections no longer arrive.", "Check the network; the client reconnects."
    ),
    "ntrip_refused": warning(
        "The caster rejects the request.", "Check mountpoint, user and password of `ntrip`."
    ),
    "source_too_fast": warning(
        "A source sends faster than allowed; it is not used.",
        "Lower the output rate of the device.",
    ),
    "measurement_failed": error("A measurement could not be computed.", BUG),
}

RECEIVERS: Mapping[str, Entry] = {
    "implausible_date": warning(
        "The receiver's date cannot be right.", "Update the receiver's firmware."
    ),
    "baud_followed": warning(
        "The receiver sends at another baud rate; it is read at that.",
        "Correct `baud`, or set the receiver's rate.",
    ),
    "checksum_missing": info("Sentences without a checksum are rejected.", "Switch checksums on."),
    "height_above_sea": info(
        "The receiver gives no geoid separation; sigma is 62 m.",
        "Switch the geoid separation on in GGA.",
    ),
    "height_not_measured": info(
        "Fixes have no height of their own.", "Give the antenna more sky, or set 3-D mode."
    ),
    "height_missing": info("GGA has no altitude.", "Switch the altitude on in GGA."),
    "rmc_alone": info("Only RMC has a position: no height, large sigma.", "Switch on GGA and GST."),
    "gll_alone": info(
        "Only GLL has a position: no height, large sigma.", "Switch on GGA, RMC and GST."
    ),
    "attitude_left_out": info(
        "A receiver sends its heading only in a proprietary sentence.",
        "Switch on THS or HDT at the receiver.",
    ),
    "compass_left_out": info(
        "Headings of a compass arrive on a receiver's port.",
        'Give it a source with driver = "compass".',
    ),
    "bad_date": warning("The date in RMC is invalid.", "Set the receiver's date."),
    "integrated": info(
        "Positions come from a plotter or adapter, not from a receiver.",
        "Connect the receiver itself (talker GP or GN).",
    ),
    "unknown_status": info(
        "RMC has an unknown status; its velocity is not used.", "Check the firmware."
    ),
    "two_receivers": warning("Two receivers send on one line.", "Give each a port of its own."),
    "course_missing": info("Speeds without course: no velocity.", "Switch on the course in RMC."),
    "speed_held_at_zero": info("A receiver prints 0 when slow.", "Switch static navigation off."),
}

TERMINAL: Mapping[str, Entry] = {
    "rdss_card": info("The RDSS terminal answers: card, family, baud rate."),
    "rdss_beam": info("The terminal has a beam to transmit on."),
    "rdss_lifted": info("The terminal may transmit again."),
    "rdss_hold_over": info("The hold time is over; fixes are requested again."),
    "rdss_request": info("An operator requested a fix."),
    "rdss_self_test": info(
        "The terminal reported its self test.", "If it failed, have it repaired."
    ),
    "rdss_no_answer": warning(
        "No terminal answers at these baud rates.",
        "Check power, wiring and `baud`; both directions are needed.",
    ),
    "rdss_no_card": error("The terminal has no user card.", "Insert the card."),
    "rdss_no_beam": warning(
        "The terminal receives no satellite.", "Give its antenna a free view to the equator."
    ),
    "rdss_no_fixes": warning(
        "Several requests in a row brought no fix.",
        "Check the antenna's view; see `beams` in `health`.",
    ),
    "rdss_silent": warning("The terminal stopped answering.", WIRING),
    "rdss_closed": warning("The line to the terminal closed.", WIRING),
    "rdss_low_battery": warning(
        "Battery low: the terminal does not transmit.", "Charge or supply the terminal."
    ),
    "rdss_suppressed": warning(
        "The RDSS centre suppresses this card.",
        "Wait: requests resume by themselves; ask the operator of the service.",
    ),
    "rdss_silence": warning("Radio silence is set at the terminal.", "Lift it at the terminal."),
    "rdss_encryption_error": warning(
        "The card's encryption failed twice.", "Reinsert the card; have it checked."
    ),
    "rdss_crc_error": warning(
        "Requests reach the terminal damaged.", "Check cable, ground and baud rate."
    ),
    "rdss_no_permission": warning(
        "The card may not request positions.", "Have the service activated."
    ),
}

MESSAGES: Mapping[str, Entry] = {
    "message_unconfirmed": warning(
        "A message was sent; no receipt came.", "Send it again if it matters."
    ),
    "message_failed": error("A message was not sent.", "Send it again."),
    "message_expired": warning("A message waited too long and was dropped.", "Send it again."),
    "message_too_long": warning("A message is longer than the card allows.", "Shorten it."),
    "message_forbidden": warning("The card may not send messages.", "Have the service activated."),
    "message_no_permission": warning(
        "The card may not send messages.", "Have the service activated."
    ),
    "message_unsayable": warning(
        "The terminal cannot encode a message.", "Check card number and characters."
    ),
    "message_crc": warning("A message arrived damaged.", "Ask for it again."),
    "message_cut": warning("A message arrived incomplete.", "Ask for it again."),
    "message_damaged": warning("A message arrived damaged.", "Ask for it again."),
    "message_version": warning(
        "A message is from a later version.", "Update fusiond on this vehicle."
    ),
    "message_other_card": warning(
        "A message for another card arrived.",
        "If it was for you, tell the sender your card number.",
    ),
    "messages_damaged": warning("The file of stored messages is damaged; it was set aside.", DISK),
    "messages_not_kept": warning("Messages cannot be stored over a restart.", DISK),
    "report_refused": warning("A position report was not queued.", "Correct [position_reports]."),
}

CLOCK: Mapping[str, Entry] = {
    "utc_jumped": warning("UTC of a source jumped.", "Check the receiver if this repeats."),
    "utc_implausible": warning(
        "A source reports an impossible year; it is not used as UTC.",
        "Update the receiver's firmware.",
    ),
    "host_resumed": warning("The computer was suspended.", "Run `systemctl mask suspend.target`."),
    "system_clock_stepped": warning(
        "The system clock was set; navigation continues.", "Nothing to do."
    ),
}

NAVIGATION: Mapping[str, Entry] = {
    "mode_waiting": info("No IMU data.", "Check power and bus of the IMU."),
    "mode_aligning": info("Alignment runs; no solution yet.", "Do what the text asks for."),
    "mode_navigating": info("The solution is usable."),
    "mode_coasting": info(
        "Inertial navigation without a position fix.", "Restore GNSS or RDSS; sigma grows."
    ),
    "mode_invalid": warning(
        "The solution is not usable.", "Do not navigate by it; do what the text asks for."
    ),
    "not_aligned": info(
        "Alignment waits for something.", "Do what the text asks; see docs/troubleshooting.md."
    ),
    "aligned": info("Navigation started; the text names the heading's source."),
    "states_absent": warning(
        "The model lacks states that this IMU needs.", "Choose the model it names."
    ),
    "heading_contradicted": warning(
        "The start heading disagrees with the motion; alignment restarts.",
        "Drive on; if it repeats, check `axes` in [imu].",
    ),
    "saved_elsewhere": info(
        "The vehicle moved while off; the saved heading is not used.", "Drive on."
    ),
    "fixes_late": info(
        "Fixes are older than their stamps; the delay is corrected.",
        "Raise the baud rate or send fewer sentences.",
    ),
    "diverged": warning(
        "The solution diverged; alignment restarts.",
        "If it repeats: check axes, lever arms, `mounting_deg`.",
    ),
    "filter_not_finite": warning(
        "The filter overflowed; alignment restarts.", "Report the recording as a bug."
    ),
    "calibrated": info("A calibration parameter settled."),
    "calibration_refused": warning(
        "The saved calibration is wrong and is not used.", "Check the IMU's mounting."
    ),
    "calibration_damaged": warning("The saved calibration is damaged; it was set aside.", DISK),
    "saved_state_refused": warning(
        "The saved heading is too old or of another setup.", "Nothing to do: alignment runs."
    ),
    "saved_state_damaged": warning("The saved state is damaged; it was set aside.", DISK),
    "warm_state_refused": warning(
        "The state of the last run is not used.", "Nothing to do: alignment runs."
    ),
    "warm_state_damaged": warning("The state of the last run is damaged; it was set aside.", DISK),
    "warm_start_refused": warning(
        "A fix contradicts the state of the last run; alignment restarts.",
        "Nothing to do, if the vehicle was moved while off.",
    ),
    "isolated": warning(
        "A source is excluded from the solution.",
        "Wait; if no `readmitted` follows, see `diagnosis` in `health`.",
    ),
    "readmitted": info("A source is used again."),
    "sensor_fault": error(
        "A step of a sensor was corrected; navigation continues.",
        "Check mounting, temperature and wiring of the device.",
    ),
    "fault_over": info("A slow drift of a source ended; the solution was corrected."),
    "protection_level": warning(
        "The protection level exceeds its limit.", "Do not rely on the position."
    ),
    "protection_restored": info("The protection level is within its limit again."),
    "verdict_consistent": info("Sigma of a source fits its errors."),
    "verdict_optimistic": warning(
        "Sigma of a source is too small.", "Raise `sigma_scale` of its section."
    ),
    "verdict_pessimistic": warning(
        "Sigma of a source is too large.", "Lower `sigma_scale` of its section."
    ),
    "verdict_coloured": warning(
        "Errors of a source last from fix to fix; sigma may be too small.",
        "Nothing now; its remedies are in docs/consistency.md.",
    ),
    "verdict_cannot_tell": info("The test cannot judge this source's sigma."),
    "verdict_too_few": info("Too few innovations to judge this source's sigma."),
}

IMU: Mapping[str, Entry] = {
    "imu_gap": warning("The IMU was silent too long; alignment restarts.", "Check power and bus."),
    "imu_not_finite": warning(
        "IMU samples are not numbers; rejected.", "Check the DBC or the unit."
    ),
    "imu_out_of_range": warning(
        "IMU samples exceed any sensor's range.", "Check units and byte order."
    ),
    "imu_saturated": warning(
        "IMU samples are at full scale.", "Choose a larger range in the unit."
    ),
    "imu_repeated": warning("The IMU repeats one sample.", "Restart the unit; check its firmware."),
    "imu_no_gravity": warning(
        "No gravity in the IMU's data: dead sensor or wrong unit.", "Check `accel_unit` or the DBC."
    ),
    "imu_spike": warning(
        "IMU samples jump more than a vehicle can.", "Check the line and the unit."
    ),
    "imu_stamp_ahead": warning(
        "An IMU sample is stamped later than the next one.", "Check the unit's clock."
    ),
    "imu_time": warning(
        "IMU stamps went back or lie ahead; alignment restarts.", "Check the unit's clock."
    ),
    "imu_axis_dead": warning("One IMU axis is stuck.", "Check the DBC; replace the unit."),
    "imu_sound": info("IMU samples are accepted again."),
    "imu_units": warning("IMU data are in another unit.", "Correct `gyro_unit` or `accel_unit`."),
    "imu_units_well": info("IMU rates fit the motion again."),
    "imu_upside_down": warning(
        "The IMU is mounted upside down.", "Correct `axes` in [imu], then restart."
    ),
    "imu_backwards": warning(
        "The IMU seems mounted backwards.", "Correct `axes` in [imu], then restart."
    ),
    "without_imu": warning(
        "No IMU data: receivers alone are fused.", "Check power and bus of the IMU."
    ),
    "with_imu": info("Inertial navigation took over again."),
    "imu_spare": warning(
        "The spare IMU is used.", "Check the first unit; a restart returns to it."
    ),
}

DAEMON: Mapping[str, Entry] = {
    "reloaded": info("The configuration was reloaded."),
    "restart_needed": warning("Some changes apply only after a restart.", "Restart the service."),
    "reload_refused": warning(
        "The new configuration has mistakes.", "Run `fusiond check`, then reload."
    ),
    "reload_fault": error("The reload failed.", BUG),
    "injected": warning("A simulated fault is active.", "Do not navigate by this solution."),
    "injection_ended": info("The simulated fault ended."),
    "recording_started": info("Recording started."),
    "recording_stopped": info("Recording stopped."),
    "recording_failed": error("Recording failed.", DISK),
}

OUTPUTS: Mapping[str, Entry] = {
    "output_fault": error("An output failed and was restarted.", BUG),
    **{
        f"{name}_absent": warning(
            f"The {name} server cannot listen; it retries.",
            f"Free the port, or change [outputs.{name}].",
        )
        for name in ("nmea", "gpsd", "prometheus", "foxglove")
    },
    **{
        f"{name}_clients_refused": warning(
            f"The {name} server has no room for clients.",
            "Close clients, or raise the limit of open files.",
        )
        for name in ("nmea", "gpsd", "prometheus", "foxglove")
    },
    "chrony_absent": warning(
        "chrony's socket does not exist.", "Start chrony; check its `refclock SOCK`."
    ),
    "foxglove_origin_refused": warning(
        "A web page of another site was rejected.",
        "Add it to `outputs.foxglove.origins` if it is yours.",
    ),
    "mqtt_connected": info("Connected to the MQTT broker."),
    "mqtt_absent": warning(
        "No MQTT broker at this address; retrying.", "Start the broker, or correct [mqtt]."
    ),
    "mqtt_lost": warning(
        "The connection to the broker ended; reconnecting.", "Check broker and network."
    ),
    "mqtt_flooded": warning(
        "Another client floods the command topics.", "Find it in the broker's log."
    ),
    "mqtt_command_failed": error("A command failed inside the daemon.", BUG),
    "mqtt_password_exposed": warning(
        "All users can read the password file.", "Run `chmod 600` on the file."
    ),
    "client_name_taken": warning(
        "Another MQTT client has this daemon's name.", "Give each daemon its own `mqtt.client_id`."
    ),
}

EVENTS: Mapping[str, Entry] = {
    **DEVICES,
    **RECEIVERS,
    **TERMINAL,
    **MESSAGES,
    **CLOCK,
    **NAVIGATION,
    **IMU,
    **DAEMON,
    **OUTPUTS,
}

UNKNOWN = info("An event of a driver from another package.")


def entry_of(code: str) -> Entry:
    """Entry of a code; `UNKNOWN` for one that no part of fusiond reports."""
    return EVENTS.get(code, UNKNOWN)
