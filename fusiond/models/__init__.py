"""The error state: blocks, and models as lists of blocks."""
