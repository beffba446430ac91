"""Where the numbers of a set-point stand in one flat array.

Compiled code takes one such array instead of ten small ones: each costs it time at every call.
"""

from __future__ import annotations

from typing import Final

STIFFNESS: Final = 0
"""In axes of D: translation [N/m], rotation [N m/rad], 6."""
DAMPING_RATIO: Final = 6
"""[1], 6."""
JOINT_STIFFNESS: Final = 12
"""[N m/rad], 7."""
P_WD: Final = 19
"""[m], 3."""
V_WD: Final = 22
"""Linear [m/s] then angular [rad/s], 6."""
F_W: Final = 28
"""Force [N] then torque [N m], 6."""
Q: Final = 34
"""[rad], 7."""
QD: Final = 41
"""[rad/s], 7."""
R_WD: Final = 48
"""Row by row, 9."""
SETPOINT: Final = 57
"""Numbers of a set-point."""
QDD: Final = 57
"""[rad/s^2], 7: a reference has them besides."""
REFERENCE: Final = 64
"""Numbers of a reference."""
