"""What the recorded receiver module of CSS says of one epoch, by message and signal."""

from __future__ import annotations

from drivers.can.dbc import load_dbc

MODULE = load_dbc("css_canmod_gps")
EPOCH_S = 1_627_275_510.0
GOOD: dict[str, dict[str, float]] = {
    "gnss_status": {"FixType": 3, "Satellites": 13},
    "gnss_time": {"TimeValid": 1, "TimeConfirmed": 1, "Epoch": EPOCH_S},
    "gnss_pos": {
        "PositionValid": 1,
        "Latitude": 56.030215,
        "Longitude": 10.061796,
        "PositionAccuracy": 3,
    },
    "gnss_altitude": {"AltitudeValid": 1, "Altitude": 127.9, "AltitudeAccuracy": 2},
    "gnss_attitude": {
        **dict.fromkeys(("Roll", "RollAccuracy", "Pitch", "PitchAccuracy"), 0),
        **{"AttitudeValid": 1, "Heading": 227.9, "HeadingAccuracy": 0.2},
    },
    "gnss_speed": {"SpeedValid": 1, "Speed": 22.868, "SpeedAccuracy": 0.208},
}
