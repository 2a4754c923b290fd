"""Simulated RDSS: ground centre and user terminal of a double-star system."""
