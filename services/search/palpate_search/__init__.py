"""Search: selects the next press from the measurements, and decides when to stop."""
