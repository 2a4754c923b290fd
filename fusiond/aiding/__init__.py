"""Measurements: one module a kind of measurement, each with its innovation, Jacobian and noise."""
