"""Recorded files through the daemon's navigator; comparison with a truth."""
