"""Federated filtering (paper 004)."""
