"""Simulated vehicle: its motion, the output of its sensors, and devices that send it on lines."""
