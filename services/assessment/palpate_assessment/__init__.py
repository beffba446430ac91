"""Assessment: palpation samples to a stiffness map with its uncertainty, and to findings."""
