"""The arm simulated in DART."""
