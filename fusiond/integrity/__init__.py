"""Integrity: whether what the filter says about itself can be believed."""
