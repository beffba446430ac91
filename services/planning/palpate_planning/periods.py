"""Units of time."""

MS = 1_000_000
"""A millisecond [ns]."""
SECOND = 1_000 * MS
"""A second [ns]."""
