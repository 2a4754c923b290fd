"""Demo: a simulated vehicle with virtual devices, the real daemon, and a view on a terminal."""
