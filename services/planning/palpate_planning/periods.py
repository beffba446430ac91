"""Units of time."""

from typing import Final

MS: Final = 1_000_000
"""A millisecond [ns]."""
SECOND: Final = 1_000 * MS
"""A second [ns]."""
