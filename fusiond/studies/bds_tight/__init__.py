"""Tight against loose coupling (paper 003)."""
