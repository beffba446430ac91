"""What the parts and whole runs cost, and what examinations do when something fails."""
