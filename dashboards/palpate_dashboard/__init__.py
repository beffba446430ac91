"""Dashboard: what happens on the bus, drawn in rerun."""
