"""Workers: many runs of one function on many processes, here or on a cluster."""
