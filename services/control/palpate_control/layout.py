"""Where the numbers of a set-point, and of the reference that follows from it, stand in one flat array.

Compiled code takes one such array instead of ten small ones: each costs it time at every call.
"""

from __future__ import annotations

from typing import Final

import numpy as np

NUMBERS: Final = np.dtype(
    [
        ("stiffness", np.float64, 6),  # in axes of D: translation [N/m], rotation [N m/rad]
        ("damping_ratio", np.float64, 6),  # [1]
        ("joint_stiffness", np.float64, 7),  # [N m/rad]
        ("p_WD", np.float64, 3),  # [m]
        ("V_WD", np.float64, 6),  # linear [m/s] then angular [rad/s]
        ("F_W", np.float64, 6),  # force [N] then torque [N m]
        ("q", np.float64, 7),  # [rad]
        ("qd", np.float64, 7),  # [rad/s]
        ("R_WD", np.float64, (3, 3)),
        ("qdd", np.float64, 7),  # [rad/s^2]: zero in a set-point, and in mode CARTESIAN
    ]
)
"""What set-points and references consist of."""


def _start(name: str) -> int:
    """Where a part begins."""
    fields = NUMBERS.fields
    assert fields is not None
    return int(fields[name][1]) // np.dtype(np.float64).itemsize


STIFFNESS: Final = _start("stiffness")
DAMPING_RATIO: Final = _start("damping_ratio")
JOINT_STIFFNESS: Final = _start("joint_stiffness")
P_WD: Final = _start("p_WD")
V_WD: Final = _start("V_WD")
F_W: Final = _start("F_W")
Q: Final = _start("q")
QD: Final = _start("qd")
R_WD: Final = _start("R_WD")
QDD: Final = _start("qdd")
COUNT: Final = NUMBERS.itemsize // np.dtype(np.float64).itemsize
"""How many numbers that are."""
