"""What the numerics cost, as ratios to one numpy product."""
