"""Studies: the papers' experiments, one module each."""
