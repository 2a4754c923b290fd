"""Estimators: models of the error state and the filters that run on them."""
