"""What a study's tables say. Definitions and their sources are in docs/scoring.md."""
