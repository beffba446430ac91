"""What the parts and whole runs cost, and how well examinations go over seeds, swaps and faults."""
