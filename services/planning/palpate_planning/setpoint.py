"""Set-points of the impedance controller, as arrays."""

from __future__ import annotations

from enum import IntEnum
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def _fixed(values: list[float]) -> Array:
    array = np.array(values)
    array.setflags(write=False)
    return array


class ControlMode(IntEnum):
    """As in palpation_msgs/ImpedanceSetpoint."""

    CARTESIAN = 0
    JOINT = 1


NORMAL_STIFFNESS: Final = 5000.0
"""K_z [N/m] along the tool: with it depth errs by 0.4 to 1.5 mm even before regulation."""
CARTESIAN_STIFFNESS: Final = _fixed([3000.0, 3000.0, NORMAL_STIFFNESS, 250.0, 250.0, 100.0])
"""[N/m, N m/rad] in axes of the indenter: firm along the tool, yielding across it, softest in the spin that does not matter."""
DAMPING_RATIO: Final = _fixed([0.8] * 6)
JOINT_STIFFNESS: Final = _fixed([800.0, 800.0, 600.0, 600.0, 400.0, 300.0, 200.0])
"""Free motion [N m/rad]."""
POSTURE_STIFFNESS: Final = _fixed([20.0] * 7)
"""Null space in contact [N m/rad]; the controller caps its torque at 5 N m."""
_STILL: Final = _fixed([0.0] * 6)
_NO_FORCE: Final = _fixed([0.0] * 3)
_JOINTS_STILL: Final = _fixed([0.0] * 7)


class Setpoint(NamedTuple):
    """What the arm is to do now, and how it goes on: control extrapolates by `V_WI` and `qd`."""

    mode: ControlMode
    X_WI: Array
    """Desired pose of the indenter, shape (4, 4)."""
    q: Array
    """JOINT: target; CARTESIAN: posture [rad], shape (7,)."""
    V_WI: Array = _STILL
    """Linear [m/s] and angular [rad/s] velocity in world axes, shape (6,)."""
    F_W: Array = _NO_FORCE
    """Feed-forward force on the environment [N], world axes, shape (3,)."""
    qd: Array = _JOINTS_STILL
    """Velocity of q [rad/s], shape (7,)."""
    limp: bool = False
    """JOINT without stiffness: asks for nothing, keeps the chain of commands alive."""

    @property
    def stiffness(self) -> Array:
        """Cartesian stiffness, shape (6,)."""
        return CARTESIAN_STIFFNESS

    @property
    def joint_stiffness(self) -> Array:
        """Joint or null-space stiffness [N m/rad], shape (7,)."""
        if self.limp:
            return _JOINTS_STILL
        return JOINT_STIFFNESS if self.mode is ControlMode.JOINT else POSTURE_STIFFNESS
