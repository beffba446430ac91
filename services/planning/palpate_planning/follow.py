"""Free motion and rest in joint space, one set-point a period."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from palpate_planning.kinematics import Kinematics
from palpate_planning.setpoint import ControlMode, Setpoint
from palpate_planning.timing import JointTrajectory

Array = NDArray[np.float64]


class Follower:
    """Holds a posture, or follows a trajectory to its end and holds there."""

    def __init__(self, kinematics: Kinematics, q: Array) -> None:
        """At rest at q [rad], shape (7,)."""
        self._kinematics = kinematics
        self.hold(q)

    def hold(self, q: Array) -> None:
        """Stays at q."""
        self._trajectory = JointTrajectory(np.array(q, dtype=float)[None], np.zeros((1, 7)))
        self._k = 0.0

    def start(self, trajectory: JointTrajectory) -> None:
        """Follows a trajectory from the next step on."""
        self._trajectory, self._k = trajectory, 0.0

    @property
    def arrived(self) -> bool:
        """Whether the last set-point was the trajectory's end."""
        return self._k >= len(self._trajectory) - 1

    @property
    def q(self) -> Array:
        """The posture set last [rad], shape (7,)."""
        return self._trajectory.at(self._k)[0]

    def step(self, rate: float = 1.0) -> Setpoint:
        """The set-point of this period, `rate` samples on; see `Pace`."""
        self._k = min(self._k + rate, len(self._trajectory) - 1.0)
        q, qd = self._trajectory.at(self._k)
        return Setpoint(ControlMode.JOINT, self._kinematics.pose(q), q, qd=rate * qd)
