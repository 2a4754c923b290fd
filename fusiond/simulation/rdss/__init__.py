"""A simulated double-star centre and terminal."""
