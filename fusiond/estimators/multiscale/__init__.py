"""The multi-scale block filter."""
