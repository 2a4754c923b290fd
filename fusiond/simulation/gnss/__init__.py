"""Simulated satellites and receivers, their fixes and raw streams."""
