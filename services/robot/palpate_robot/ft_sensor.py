"""What a six-axis force/torque sensor reads: the wrench on it, a constant bias and white noise."""

from __future__ import annotations

import numpy as np
from palpate_models.frames import Array
from palpate_models.scenario import Robot

_BLOCK = 1024


class FtSensor:
    """Adds the sensor's errors to the true wrench. Wrenches: force [N], then moment [N m], shape (6,), in its axes."""

    def __init__(self, robot: Robot, rng: np.random.Generator) -> None:
        """Draws the bias, uniform within +- the scenario's scale."""
        scale = np.repeat((robot.ft_bias_n, robot.ft_bias_nm), 3)
        self.bias: Array = rng.uniform(-scale, scale)
        self._deviation = np.repeat((robot.ft_noise_n, robot.ft_noise_nm), 3)
        self._rng = rng
        self._errors: Array = np.empty((0, 6))
        self._next = 0

    def read(self, wrench: Array) -> Array:
        """A reading of the true wrench, a fresh array of shape (6,)."""
        if self._next == len(self._errors):
            self._errors = self.bias + self._deviation * self._rng.standard_normal((_BLOCK, 6))
            self._next = 0
        self._next += 1
        return np.asarray(wrench + self._errors[self._next - 1])
