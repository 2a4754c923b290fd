"""Cost of the numerics, as ratios to one numpy product."""
