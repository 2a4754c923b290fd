"""A simulated vehicle on virtual devices, served by the real daemon, with a view on a terminal."""
