"""NMEA 0183 receivers."""
