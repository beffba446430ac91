"""Results of a run: scores, report, map, page."""
