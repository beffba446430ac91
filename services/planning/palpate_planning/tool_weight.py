"""Contact force from the force/torque sensor: bias by taring in free air, weight of the tool by its orientation.

The sensor S reads, in its own axes, F_S = R_SW (F_contact + m (g - a)) + bias. With the mass known, the bias is the mean of
F_S - R_SW m g at rest while nothing is touched, in whatever orientations. Torques are not used.
"""

from __future__ import annotations

import numpy as np

from palpate_models.numerics.frames import Array
from palpate_models.numerics.gravity import GRAVITY
from palpate_models.robot import lbr
from palpate_models.scenario.schema import Robot


class ToolWeight:
    """The tool below the sensor, and the sensor's bias."""

    def __init__(self, mass: float) -> None:
        """`mass` [kg] below the sensor."""
        self.mass = mass
        self.weight_W: Array = np.array((0.0, 0.0, -mass * GRAVITY))
        """[N], world axes, shape (3,)."""
        self.bias = np.zeros(3)
        """Force [N] that the sensor reads where there is none, in its axes, shape (3,)."""
        self.tared = False
        """Whether the bias has been measured at all."""
        self._sum = np.zeros(3)
        self._count = 0

    @staticmethod
    def of(robot: Robot) -> ToolWeight:
        """From the robot's tables: stand-off and sphere."""
        inertia = lbr.inertias(robot)
        return ToolWeight(inertia["ft_sensor"].mass + inertia["indenter"].mass)

    def force(self, R_WS: Array) -> Array:
        """The weight as the sensor sees it [N], in its axes, shape (3,)."""
        return np.asarray(R_WS.T @ self.weight_W)

    def start_tare(self) -> None:
        """Forgets earlier readings; the bias stays as it is until the first reading."""
        self._sum, self._count = np.zeros(3), 0

    def tare(self, R_WS: Array, wrench_S: Array) -> None:
        """Takes a reading in free air, force and torque, shape (6,), into the bias."""
        self._sum += wrench_S[:3] - self.force(R_WS)
        self._count += 1
        self.tared = True
        self.bias = self._sum / self._count

    def contact(self, R_WS: Array, wrench_S: Array, a_W: Array) -> Array:
        """Force [N] that the environment exerts on the tool, world axes, shape (3,).

        `a_W`: acceleration of the tool [m/s^2], shape (3,): 0.5 m/s^2 of 0.35 kg would pass for a touch.
        """
        return np.asarray(R_WS @ (wrench_S[:3] - self.bias) - self.weight_W + self.mass * a_W)
