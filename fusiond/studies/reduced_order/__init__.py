"""23 states against 17 (paper 002)."""
