"""Outputs of the daemon."""
