"""Runs of the daemon's navigator over recorded files; comparison with a truth."""
