"""Devices on a CAN bus, described by DBC files."""
