"""Multi-scale block filtering (paper 001)."""
