"""Delayed double-star fixes (paper 000)."""
