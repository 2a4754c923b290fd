"""Batch: many drives, each a row of figures, on as many processes as there are."""
