"""Fixed-interval smoothing: a tape of the filter's updates, and the backward pass."""
