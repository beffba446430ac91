"""Gravity, once for all."""

from typing import Final

GRAVITY: Final = 9.80665
"""Standard gravity [m/s^2] (3rd CGPM, 1901)."""
