"""What is true of a simulated patient, found out by pressing a copy of him: for scoring alone."""
