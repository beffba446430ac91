"""What a run leaves: scores, report, map, page."""
