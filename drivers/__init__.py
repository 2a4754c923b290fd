"""Drivers: bytes and frames in, measurements out. Imports nothing of fusiond."""
