"""Samples and measurements in, solution out: intake, alignment, timeline."""
