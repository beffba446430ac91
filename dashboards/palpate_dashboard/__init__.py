"""Dashboard: draws a run in rerun."""
