"""Gravity, once for all."""

from typing import Final

GRAVITY: Final = 9.81
"""Along -z of world [m/s^2]: the value that pinocchio takes of itself, so that plant, controller and planner agree."""
