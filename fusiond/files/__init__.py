"""Tables of numbers on disk."""
