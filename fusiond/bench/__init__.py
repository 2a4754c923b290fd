"""Cost of the numerics, as ratios to the cost of one numpy product."""
