"""Recordings: what came in, tick by tick, and what came of it, as MCAP (docs/recording.md)."""
