"""Recorded files through the daemon's navigator, and what came of it against truth."""
