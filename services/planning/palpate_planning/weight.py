"""Contact force from the F/T sensor: bias by taring in free air, the tool's weight by its orientation.

The sensor S reads, in its own axes, F_S = R_SW (F_contact + m (g - a)) + bias. With mass and centre of mass known, the
bias is the mean of F_S - R_SW m g at rest while nothing is touched, in whatever orientations.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from palpate_models import lbr
from palpate_models.scenario import Robot

from palpate_planning.poses import cross

Array = NDArray[np.float64]

GRAVITY = 9.80665
"""Standard gravity [m/s^2] (CGPM 1901)."""


class ToolWeight:
    """The tool below the sensor, and the sensor's bias."""

    def __init__(self, mass: float, com_S: Array, gravity: float = GRAVITY) -> None:
        """`mass` [kg] below the sensor and its centre `com_S` [m] in sensor axes."""
        self.mass, self.com_S = mass, com_S
        self._weight_W = np.array((0.0, 0.0, -mass * gravity))
        self.bias = np.zeros(6)
        self._sum = np.zeros(6)
        self._count = 0

    @staticmethod
    def of(robot: Robot) -> ToolWeight:
        """From the robot's tables: stand-off and sphere."""
        inertia = lbr.inertias(robot)
        standoff, sphere = inertia["ft_sensor"], inertia["indenter"]
        mass = standoff.mass + sphere.mass
        tip = np.array((0.0, 0.0, lbr.FT_TO_INDENTER_M)) + np.array(sphere.com)
        return ToolWeight(mass, (standoff.mass * np.array(standoff.com) + sphere.mass * tip) / mass)

    def wrench(self, R_WS: Array) -> Array:
        """The weight as the sensor sees it: force [N] and torque [N m] at its origin in its axes, shape (6,)."""
        force = R_WS.T @ self._weight_W
        return np.concatenate((force, cross(self.com_S, force)))

    def start_tare(self) -> None:
        """Forgets earlier readings; the bias stays as it is until the first reading."""
        self._sum, self._count = np.zeros(6), 0

    def tare(self, R_WS: Array, wrench_S: Array) -> None:
        """Takes a reading in free air, shape (6,), into the bias."""
        self._sum += wrench_S - self.wrench(R_WS)
        self._count += 1
        self.bias = self._sum / self._count

    @property
    def readings(self) -> int:
        """How many readings the bias stands on."""
        return self._count

    def contact(self, R_WS: Array, wrench_S: Array, a_W: Array | None = None) -> Array:
        """Force [N] that the environment exerts on the tool, world axes, shape (3,).

        `a_W`: acceleration of the tool [m/s^2], shape (3,): 0.5 m/s^2 of 0.35 kg would pass for a touch.
        """
        force = R_WS @ (wrench_S[:3] - self.bias[:3] - R_WS.T @ self._weight_W)
        return np.asarray(force if a_W is None else force + self.mass * a_W)
