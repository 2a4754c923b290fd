"""The parsers that are fuzzed: what of each is traced, and how long its inputs are."""

from __future__ import annotations

from typing import NamedTuple


class Parser(NamedTuple):
    """`length`: bytes that hold two of the longest messages that matter; a run takes as long as its
    input is, so that what only long ones reach has a pass of its own."""

    modules: tuple[str, ...]
    length: int


_NMEA = ("decoder", "epoch_assembly", "fields", "time")
_RAW = ("decoder", "rtcm", "ubx", "weeks")
_WORDS = ("bcnav", "beidou_words", "bits", "d1", "d2", "decoder", "inav", "lnav", "subframes")
_SHARED = (
    "drivers.epoch_ends",
    "drivers.solution",
    "drivers.solution_decoder",
    "drivers.framing_base",
)
_HUB = ("advice", "history", "vehicles", "message_parser", "vehicle")

PARSERS = {
    "splitter": Parser(("drivers.nmea.mixed_framing",), 128),
    "nmea": Parser(tuple(f"drivers.nmea.{m}" for m in _NMEA), 256),
    "raw": Parser(tuple(f"drivers.raw.{m}" for m in _RAW), 192),
    "ssr": Parser(("drivers.raw.ssr",), 160),
    "words": Parser(tuple(f"drivers.raw.{m}" for m in (*_WORDS, "weeks")), 128),
    "ubx": Parser(("drivers.ubx.decoder", "drivers.ubx.messages", *_SHARED), 256),
    "bestpos": Parser(("drivers.bestpos.decoder", "drivers.bestpos.framing", *_SHARED), 640),
    "sbf": Parser(("drivers.sbf.decoder", "drivers.sbf.framing", *_SHARED), 256),
    "rinex": Parser(
        ("drivers.raw.rinex", "drivers.raw.rinex2_to_3", "drivers.raw.rinex_nav"), 1200
    ),
    "rdss_binary": Parser(("drivers.rdss.framing", "drivers.rdss.binary_4_0"), 128),
    "rdss_text": Parser(("drivers.rdss.framing", "drivers.rdss.text_2_1"), 128),
    "rdss_mail": Parser(
        (
            "drivers.rdss.vehicle_message_envelope",
            "drivers.rdss.inbox",
            "drivers.rdss.position_report_coding",
            "drivers.rdss.text_coding",
        ),
        212,
    ),
    "can": Parser(
        tuple(f"drivers.can.{m}" for m in ("dbc", "decoder", "signal_bits", "pairing")), 162
    ),
    "ntrip": Parser(("drivers.ntrip.protocol",), 200),
    "commands": Parser(("fusiond.outputs.commands",), 256),
    "hub": Parser(tuple(f"fusiond.dashboard.{module}" for module in _HUB), 512),
    "log": Parser(tuple(f"fusiond.recording.{m}" for m in ("info", "reader", "records")), 400),
    "state": Parser(("fusiond.navigator.state_file", "fusiond.navigator.saved_state"), 384),
    "can_log": Parser(
        tuple(f"fusiond.offline.{m}" for m in ("blf_repair", "can_log_reader", "can_text_repair")),
        400,
    ),
    "dbc": Parser(("drivers.can.dbc_salvage",), 400),
    "csv": Parser(
        tuple(f"fusiond.files.{m}" for m in ("csv_tables", "csv_dialect", "measurement_csv")), 160
    ),
}
"""By target."""
