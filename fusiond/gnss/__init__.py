"""Satellites: orbits, clocks, atmosphere and the range equations. No I/O, no configuration."""
