"""A simulated vehicle: motion, what its sensors would say, and devices that say it on lines."""
