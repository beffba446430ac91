"""Statistics of a study's tables. Definitions and their sources are in docs/scoring.md."""
