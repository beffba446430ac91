"""Studies that were run by hand, calibrations and comparisons; not part of the distribution."""
