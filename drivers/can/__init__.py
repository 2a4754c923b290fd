"""Devices on a CAN bus, described by DBC files."""

# Before any module of this room imports cantools, which imports python-can with all it brings.
import drivers.can.python_can_import  # noqa: F401
