"""Ground truth of a simulated patient, from pressing a copy of the tissue. For scoring only."""
