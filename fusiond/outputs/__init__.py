"""What leaves the daemon."""
