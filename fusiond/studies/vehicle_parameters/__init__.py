"""Study: whether what the filter finds of a vehicle is as good as it says."""
