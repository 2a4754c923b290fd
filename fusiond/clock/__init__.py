"""One clock: stamps of devices, buses and satellites become instants of monotonic time."""
