"""Fixed-interval smoothing: what a filter did, on a tape, and the way back over it."""
