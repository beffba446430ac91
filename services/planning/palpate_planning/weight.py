"""Contact force from the F/T sensor: bias by taring in free air, the tool's weight by its orientation.

The sensor S reads, in its own axes, F_S = R_SW (F_contact + m (g - a)) + bias. With the mass known, the
bias is the mean of F_S - R_SW m g at rest while nothing is touched, in whatever orientations. Of moments nothing is needed.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from palpate_models import lbr
from palpate_models.compiled import compiled
from palpate_models.scenario import Robot

Array = NDArray[np.float64]

GRAVITY = 9.81
"""Standard gravity [m/s^2] (CGPM 1901)."""


class ToolWeight:
    """The tool below the sensor, and the sensor's bias."""

    def __init__(self, mass: float, gravity: float = GRAVITY) -> None:
        """`mass` [kg] below the sensor."""
        self.mass = mass
        self.weight_W: Array = np.array((0.0, 0.0, -mass * gravity))
        """[N], world axes, shape (3,)."""
        self.bias = np.zeros(3)
        """Force [N] that the sensor reads where there is none, in its axes, shape (3,)."""
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
        """Takes a reading in free air, force and moment, shape (6,), into the bias."""
        self._sum += wrench_S[:3] - self.force(R_WS)
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
        return external(R_WS, wrench_S, self.bias, self.weight_W, self.mass, np.zeros(3) if a_W is None else a_W)


@compiled
def external(R_WS: Array, wrench_S: Array, bias_S: Array, weight_W: Array, mass: float, a_W: Array) -> Array:
    """`ToolWeight.contact` from its parts: force [N] on the tool, world axes, shape (3,)."""
    return np.asarray(R_WS @ (wrench_S[:3] - bias_S - R_WS.T @ weight_W) + mass * a_W)
