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
    """One code; `advice` is the operator's next step, empty where there is nothing to do."""

    level: Level
    meaning: str
    advice: str = ""


WIRING = "Check power, cable and port; `fusiond doctor` shows what arrives."
DISK = "Check free space and permissions of the directory."

DEVICES: Mapping[str, Entry] = {
    "device_absent": Entry("warning", "A port cannot be opened; the driver retries.", WIRING),
    "device_silent": Entry("warning", "A port is open and brings nothing usable.", WIRING),
    "device_running": Entry("info", "A device sends measurements."),
    "device_failed": Entry(
        "error", "A device cannot work as configured.", "Correct its section, then restart."
    ),
    "device_restarted": Entry(
        "info", "A device's clock started again.", "Check its power supply if this repeats."
    ),
    "driver_fault": Entry(
        "error", "A driver failed and was restarted.", "Report the text of the event as a bug."
    ),
    "interface_up": Entry("info", "A CAN interface is back."),
    "interface_down": Entry(
        "warning", "A CAN interface is down or does not exist.", "Run `ip link set can0 up`."
    ),
    "bus_off": Entry(
        "error",
        "The CAN controller left the bus.",
        "Check wiring, termination and bit rate; set `restart-ms`.",
    ),
    "error_passive": Entry(
        "warning", "The CAN controller sees many errors.", "Check wiring and termination."
    ),
    "error_warning": Entry(
        "warning", "The CAN controller counts errors.", "Check wiring and termination."
    ),
    "error_active": Entry("info", "The CAN controller works normally again."),
    "ntrip_starting": Entry("info", "The NTRIP client connects."),
    "ntrip_waiting": Entry("info", "The caster waits for a position of the receiver."),
    "ntrip_running": Entry("info", "Corrections arrive from the NTRIP caster."),
    "ntrip_lost": Entry(
        "warning", "Corrections no longer arrive.", "Check the network; the client reconnects."
    ),
    "ntrip_refused": Entry(
        "warning",
        "The caster rejects the request.",
        "Check mountpoint, user and password of `ntrip`.",
    ),
    "source_too_fast": Entry(
        "warning",
        "A source sends faster than allowed; it is not used.",
        "Lower the output rate of the device.",
    ),
    "aid_failed": Entry(
        "error", "A measurement could not be computed.", "Report the text of the event as a bug."
    ),
}

RECEIVERS: Mapping[str, Entry] = {
    "implausible_date": Entry(
        "warning", "The receiver's date cannot be right.", "Update the receiver's firmware."
    ),
    "checksum_missing": Entry(
        "info", "Sentences without a checksum are rejected.", "Switch checksums on."
    ),
    "height_above_sea": Entry(
        "info",
        "The receiver gives no geoid separation; sigma is 62 m.",
        "Let GGA have the separation.",
    ),
    "height_not_measured": Entry(
        "info", "Fixes are two-dimensional.", "Give the antenna more sky, or set 3-D mode."
    ),
    "height_missing": Entry("info", "GGA has no altitude.", "Switch the altitude on in GGA."),
    "rmc_alone": Entry(
        "info", "Only RMC has a position: no height, large sigma.", "Switch on GGA and GST."
    ),
    "gll_alone": Entry(
        "info",
        "Only GLL has a position: no height, large sigma.",
        "Switch on GGA, RMC and GST.",
    ),
    "attitude_left_out": Entry(
        "info",
        "A receiver tells its heading in a sentence of its maker's alone.",
        "Switch on THS or HDT at the receiver.",
    ),
    "compass_left_out": Entry(
        "info",
        "Headings of a compass arrive on a receiver's port.",
        'Give it a source with driver = "compass".',
    ),
    "bad_date": Entry("warning", "RMC has no date that is one.", "Set the receiver's date."),
    "integrated": Entry(
        "info",
        "Positions come from a plotter or adapter, not from a receiver.",
        "Connect the receiver itself (talker GP or GN).",
    ),
    "unknown_status": Entry(
        "info", "RMC has an unknown status; its velocity is not used.", "Check the firmware."
    ),
}

TERMINAL: Mapping[str, Entry] = {
    "rdss_card": Entry("info", "The RDSS terminal answers: card, family, baud rate."),
    "rdss_beam": Entry("info", "The terminal has a beam to transmit on."),
    "rdss_lifted": Entry("info", "The terminal may transmit again."),
    "rdss_hold_over": Entry("info", "The hold time is over; fixes are requested again."),
    "rdss_request": Entry("info", "An operator requested a fix."),
    "rdss_self_test": Entry(
        "info", "Result of the terminal's self test.", "Have a faulty terminal repaired."
    ),
    "rdss_no_answer": Entry(
        "warning",
        "No terminal answers at these baud rates.",
        "Check power, wiring and `baud`; both directions are needed.",
    ),
    "rdss_no_card": Entry("error", "The terminal has no user card.", "Insert the card."),
    "rdss_no_beam": Entry(
        "warning",
        "The terminal hears no satellite.",
        "Give its antenna a free view to the equator.",
    ),
    "rdss_no_fixes": Entry(
        "warning",
        "Several requests in a row brought no fix.",
        "Check the antenna's view; see `beams` in `health`.",
    ),
    "rdss_silent": Entry("warning", "The terminal stopped answering.", WIRING),
    "rdss_closed": Entry("warning", "The line to the terminal closed.", WIRING),
    "rdss_low_battery": Entry(
        "warning", "Battery low: the terminal does not transmit.", "Charge or supply the terminal."
    ),
    "rdss_suppressed": Entry(
        "warning",
        "The RDSS centre suppresses this card.",
        "Wait: requests resume by themselves; ask the operator of the service.",
    ),
    "rdss_silence": Entry(
        "warning", "Radio silence is set at the terminal.", "Lift it at the terminal."
    ),
    "rdss_encryption_error": Entry(
        "warning", "The card's encryption failed twice.", "Reinsert the card; have it checked."
    ),
    "rdss_crc_error": Entry(
        "warning", "Requests reach the terminal damaged.", "Check cable, ground and baud rate."
    ),
    "rdss_no_permission": Entry(
        "warning", "The card may not request positions.", "Have the service activated."
    ),
}

MESSAGES: Mapping[str, Entry] = {
    "message_unconfirmed": Entry(
        "warning", "A message was sent; no receipt came.", "Send it again if it matters."
    ),
    "message_failed": Entry("error", "A message was not sent.", "Send it again."),
    "message_expired": Entry(
        "warning", "A message waited too long and was dropped.", "Send it again."
    ),
    "message_too_long": Entry(
        "warning", "A message is longer than the card allows.", "Shorten it."
    ),
    "message_forbidden": Entry(
        "warning", "The card may not send messages.", "Have the service activated."
    ),
    "message_no_permission": Entry(
        "warning", "The card may not send messages.", "Have the service activated."
    ),
    "message_unsayable": Entry(
        "warning", "A message has characters that cannot be sent.", "Use other characters."
    ),
    "message_crc": Entry("warning", "A message arrived damaged.", "Ask for it again."),
    "message_cut": Entry("warning", "A message arrived incomplete.", "Ask for it again."),
    "message_damaged": Entry("warning", "A message arrived damaged.", "Ask for it again."),
    "message_version": Entry(
        "warning", "A message is from a later version.", "Update fusiond on this vehicle."
    ),
    "message_other_card": Entry("warning", "A message for another card arrived."),
    "messages_damaged": Entry(
        "warning", "The file of stored messages is damaged; it was set aside.", DISK
    ),
    "messages_not_kept": Entry("warning", "Messages cannot be stored over a restart.", DISK),
    "report_refused": Entry(
        "warning", "A position report was not queued.", "Correct [position_reports]."
    ),
}

CLOCK: Mapping[str, Entry] = {
    "utc_jumped": Entry(
        "warning", "UTC of a source jumped.", "Check the receiver if this repeats."
    ),
    "utc_implausible": Entry(
        "warning", "A source reports a year that cannot be right.", "Check the receiver."
    ),
    "host_resumed": Entry(
        "warning", "The computer was suspended.", "Switch suspend off on a vehicle."
    ),
    "system_clock_stepped": Entry("warning", "The system clock was set; navigation goes on."),
}

NAVIGATION: Mapping[str, Entry] = {
    "mode_waiting": Entry("info", "No IMU data.", "Check power and bus of the IMU."),
    "mode_aligning": Entry("info", "Alignment runs; the text says what it needs."),
    "mode_navigating": Entry("info", "The solution is usable."),
    "mode_coasting": Entry(
        "info", "Inertial navigation without a position fix.", "Restore GNSS or RDSS; sigma grows."
    ),
    "mode_invalid": Entry(
        "warning", "The solution is not usable.", "Do not navigate by it; follow the text."
    ),
    "not_aligned": Entry(
        "info", "Alignment lacks something.", "Follow the text; see docs/troubleshooting.md."
    ),
    "aligned": Entry("info", "Navigation started; the text names the heading's source."),
    "states_absent": Entry(
        "warning", "The model lacks states that this IMU needs.", "Choose the model it names."
    ),
    "heading_contradicted": Entry(
        "warning", "The start heading disagrees with the motion; alignment restarts."
    ),
    "saved_elsewhere": Entry(
        "info", "The vehicle moved while off; the saved heading is not used.", "Drive on."
    ),
    "fixes_late": Entry(
        "info", "Fixes are older than their stamps; the delay is applied.", "Check line and rate."
    ),
    "diverged": Entry(
        "warning",
        "The solution diverged; alignment restarts.",
        "If it repeats: check axes, lever arms, `mounting_deg`.",
    ),
    "filter_not_finite": Entry(
        "warning", "The filter overflowed; alignment restarts.", "Report the recording as a bug."
    ),
    "calibrated": Entry("info", "A calibration parameter settled."),
    "calibration_refused": Entry(
        "warning", "The saved calibration is wrong and is not used.", "Check the IMU's mounting."
    ),
    "calibration_damaged": Entry(
        "warning", "The saved calibration is damaged; it was set aside.", DISK
    ),
    "saved_state_refused": Entry("warning", "The saved state is too old or not for this setup."),
    "saved_state_damaged": Entry("warning", "The saved state is damaged; it was set aside.", DISK),
    "warm_state_refused": Entry("warning", "The state of the last run is not used."),
    "warm_state_damaged": Entry(
        "warning", "The state of the last run is damaged; it was set aside.", DISK
    ),
    "warm_start_refused": Entry(
        "warning", "A fix contradicts the state of the last run; alignment restarts."
    ),
    "isolated": Entry(
        "warning",
        "A source is excluded from the solution.",
        "Wait for `readmitted`; else see `diagnosis` in `health`.",
    ),
    "readmitted": Entry("info", "A source is used again."),
    "sensor_fault": Entry(
        "error",
        "A step of a sensor was corrected; navigation goes on.",
        "Check mounting, temperature and wiring of the device.",
    ),
    "fault_over": Entry("info", "A slow drift of a source ended; the solution was corrected."),
    "protection_level": Entry(
        "warning", "The protection level exceeds its limit.", "Do not rely on the position."
    ),
    "protection_restored": Entry("info", "The protection level is within its limit again."),
    "verdict_consistent": Entry("info", "Sigma of a source fits its errors."),
    "verdict_optimistic": Entry(
        "warning", "Sigma of a source is too small.", "Raise `sigma_scale` of its section."
    ),
    "verdict_pessimistic": Entry(
        "warning", "Sigma of a source is too large.", "Lower `sigma_scale` of its section."
    ),
    "verdict_coloured": Entry(
        "warning", "Errors of a source last from fix to fix.", "See docs/consistency.md."
    ),
    "verdict_cannot_tell": Entry("info", "The test cannot judge this source's sigma."),
    "verdict_too_few": Entry("info", "Too few innovations to judge this source's sigma."),
}

IMU: Mapping[str, Entry] = {
    "imu_gap": Entry(
        "warning", "The IMU was silent too long; alignment restarts.", "Check power and bus."
    ),
    "imu_not_finite": Entry(
        "warning", "IMU samples are not numbers; rejected.", "Check the DBC or the unit."
    ),
    "imu_out_of_range": Entry(
        "warning", "IMU samples exceed any sensor's range.", "Check units and byte order."
    ),
    "imu_saturated": Entry(
        "warning", "IMU samples are at full scale.", "Choose a larger range in the unit."
    ),
    "imu_repeated": Entry(
        "warning", "The IMU repeats one sample.", "Restart the unit; check its firmware."
    ),
    "imu_no_gravity": Entry(
        "warning", "No specific force: free fall or a wrong unit.", "Check `accel_unit` or the DBC."
    ),
    "imu_spike": Entry(
        "warning", "IMU samples jump more than a vehicle can.", "Check the line and the unit."
    ),
    "imu_stamp_ahead": Entry(
        "warning", "IMU stamps are ahead of later ones.", "Check the unit's clock."
    ),
    "imu_time": Entry(
        "warning", "IMU stamps went back; alignment restarts.", "Check the unit's clock."
    ),
    "imu_axis_dead": Entry(
        "warning", "One IMU axis stands still.", "Check the DBC; replace the unit."
    ),
    "imu_sound": Entry("info", "IMU samples are accepted again."),
    "imu_units": Entry(
        "warning", "IMU data are in another unit.", "Correct `gyro_unit` or `accel_unit`."
    ),
    "imu_units_well": Entry("info", "IMU rates fit the motion again."),
    "imu_upside_down": Entry(
        "warning", "The IMU is mounted upside down.", "Correct `axes` in [imu], then restart."
    ),
    "imu_backwards": Entry(
        "warning", "The IMU seems mounted backwards.", "Correct `axes` in [imu], then restart."
    ),
    "without_imu": Entry(
        "warning", "No IMU data: receivers alone are fused.", "Check power and bus of the IMU."
    ),
    "with_imu": Entry("info", "Inertial navigation took over again."),
    "imu_spare": Entry(
        "warning", "The spare IMU is used.", "Check the first unit; a restart returns to it."
    ),
}

DAEMON: Mapping[str, Entry] = {
    "reloaded": Entry("info", "The configuration was reloaded."),
    "restart_needed": Entry(
        "warning", "Some changes apply only after a restart.", "Restart the service."
    ),
    "reload_refused": Entry(
        "warning", "The new configuration has mistakes.", "Run `fusiond check`, then reload."
    ),
    "reload_fault": Entry("error", "The reload failed.", "Report the text of the event as a bug."),
    "injected": Entry(
        "warning", "A simulated fault is in force.", "Do not navigate by this solution."
    ),
    "injection_ended": Entry("info", "The simulated fault ended."),
    "recording_started": Entry("info", "Recording started."),
    "recording_stopped": Entry("info", "Recording stopped."),
    "recording_failed": Entry("error", "Recording failed.", DISK),
}

OUTPUTS: Mapping[str, Entry] = {
    "output_fault": Entry(
        "error", "An output failed and was restarted.", "Report the text of the event as a bug."
    ),
    **{
        f"{name}_absent": Entry(
            "warning",
            f"The {name} server cannot listen; it retries.",
            f"Free the port, or change [outputs.{name}].",
        )
        for name in ("nmea", "gpsd", "prometheus", "foxglove")
    },
    **{
        f"{name}_clients_refused": Entry(
            "warning",
            f"The {name} server has no room for clients.",
            "Close clients, or raise the limit of open files.",
        )
        for name in ("nmea", "gpsd", "prometheus", "foxglove")
    },
    "chrony_absent": Entry(
        "warning", "chrony's socket does not exist.", "Start chrony; check its `refclock SOCK`."
    ),
    "foxglove_origin_refused": Entry(
        "warning",
        "A web page of another site was rejected.",
        "Add it to `outputs.foxglove.origins` if it is yours.",
    ),
    "mqtt_connected": Entry("info", "Connected to the MQTT broker."),
    "mqtt_absent": Entry(
        "warning",
        "No MQTT broker at this address; retrying.",
        "Start the broker, or correct [mqtt].",
    ),
    "mqtt_lost": Entry(
        "warning", "The connection to the broker ended; reconnecting.", "Check broker and network."
    ),
    "mqtt_flooded": Entry(
        "warning", "Another client floods the command topics.", "Find it in the broker's log."
    ),
    "mqtt_command_failed": Entry(
        "error", "A command failed inside the daemon.", "Report the text of the event as a bug."
    ),
    "mqtt_password_exposed": Entry(
        "warning", "All users can read the password file.", "Run `chmod 600` on the file."
    ),
    "client_name_taken": Entry(
        "warning",
        "Another MQTT client has this daemon's name.",
        "Give each daemon its own `mqtt.client_id`.",
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

UNKNOWN = Entry("info", "An event of a driver from another package.")


def entry_of(code: str) -> Entry:
    """Entry of a code; `UNKNOWN` for one that no part of fusiond reports."""
    return EVENTS.get(code, UNKNOWN)
