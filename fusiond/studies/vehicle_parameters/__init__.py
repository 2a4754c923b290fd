"""Study: honesty of the filter's estimates of a vehicle's parameters."""
