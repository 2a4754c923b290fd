"""Replay of a recording by the daemon's own code: bit by bit the same, or with another filter."""
