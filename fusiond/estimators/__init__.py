"""Estimators: filters over one error state, with one interface."""
