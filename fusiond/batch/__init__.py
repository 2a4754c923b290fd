"""Batch: many drives, each a row of figures, on several processes."""
