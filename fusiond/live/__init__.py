"""The daemon: devices, tick and outputs put together."""
