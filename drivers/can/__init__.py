"""Devices on a CAN bus, described by DBC files."""

# First, before a module of this package imports cantools, which imports python-can.
import drivers.can.python_can_import  # noqa: F401
