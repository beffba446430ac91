"""What keeps any law's torque safe: repulsion from joint limits, saturation, and a bound on its rate."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from palpate_control import kernel

Array = NDArray[np.float64]

TORQUE_RATE_NM = 1.0
"""Largest change of a joint's torque in one millisecond [N m] (libfranka and CRISP bound it to 0.5 to 1.0)."""
REPULSION_FRACTION = 0.3
"""Repulsion at a joint limit, as a fraction of the joint's torque limit."""


class LimitRepulsion:
    """A progressive spring in the last `zone` before each joint limit: conservative, smooth at the zone's edge."""

    def __init__(self, lower: Array, upper: Array, torque_limit: Array, zone: float) -> None:
        """Limits [rad] and torque limits [N m], shapes (7,); `zone` [rad], 0 switches the repulsion off."""
        self._middle, self._half = (lower + upper) / 2, (upper - lower) / 2 - zone
        self._gain = REPULSION_FRACTION * torque_limit / max(zone, 1e-9) ** 2 if zone > 0 else np.zeros_like(lower)
        self._cap = REPULSION_FRACTION * torque_limit

    def torque(self, q: Array) -> Array | None:
        """Torque away from the limits [N m], shape (7,), or None where no joint is in its zone (the usual case)."""
        push = np.empty_like(q)
        return push if kernel.repulsion(q, self._middle, self._half, self._gain, self._cap, push) else None


class TorqueShaper:
    """Saturates torques at the joints' limits, gravity counted in, and bounds their change from tick to tick."""

    def __init__(self, torque_limit: Array, period_s: float = 1e-3) -> None:
        """Torque limits [N m], shape (7,), at one torque every `period_s`."""
        self._limit = torque_limit
        self._rate = TORQUE_RATE_NM * period_s / 1e-3
        self._last = np.zeros_like(torque_limit)

    def reset(self) -> None:
        """Starts again from zero torque, as after a pause in which nothing was commanded."""
        self._last = np.zeros_like(self._limit)

    def shape(self, torque: Array, gravity: Array) -> Array:
        """The torque that may be commanded [N m], shape (7,), such that it and it plus `gravity` are within limits."""
        shaped = np.empty_like(torque)
        kernel.shape(torque, gravity, self._limit, self._rate, self._last, shaped)
        self._last = shaped
        return shaped
