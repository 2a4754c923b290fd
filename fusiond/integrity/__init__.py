"""Integrity: tests, fault diagnosis and protection levels of the filter's published solution."""
