"""Conducts a run: start, grants of simulated time, watchdog, end."""
