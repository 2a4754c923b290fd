"""Simulated devices on a CAN bus."""
