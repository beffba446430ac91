"""What a six-axis force/torque sensor reads: the wrench on it, a constant bias and white noise."""

from __future__ import annotations

from collections.abc import Sequence
from operator import add

import numpy as np

from palpate_models.frames import Array
from palpate_models.scenario import Robot

_BLOCK = 1024


class FtSensor:
    """Adds the sensor's errors to the true wrench. Wrenches: force [N], then moment [N m], in its axes."""

    def __init__(self, robot: Robot, rng: np.random.Generator) -> None:
        """Draws the bias, uniform within +- the scenario's scale."""
        scale = np.repeat((robot.ft_bias_n, robot.ft_bias_nm), 3)
        self.bias: Array = rng.uniform(-scale, scale)
        self._deviation = np.repeat((robot.ft_noise_n, robot.ft_noise_nm), 3)
        self._rng = rng
        self._errors: list[list[float]] = []

    def read(self, wrench: Sequence[float]) -> list[float]:
        """A reading of the true wrench."""
        if not self._errors:
            self._errors = (self.bias + self._deviation * self._rng.standard_normal((_BLOCK, 6)))[::-1].tolist()
        return list(map(add, wrench, self._errors.pop()))
