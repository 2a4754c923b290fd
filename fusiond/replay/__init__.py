"""A recording through the daemon's own parts once more, with the same bits or another filter."""
