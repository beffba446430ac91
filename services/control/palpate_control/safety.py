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


class SafetyNet:
    """Between any law and the arm: torques away from joint limits, within the joints' limits, and without jumps.

    The repulsion is a progressive spring in the last `zone` before each joint limit: conservative, smooth at the zone's edge.
    Torques saturate with gravity counted in. Their change from tick to tick is bounded.
    """

    def __init__(self, lower: Array, upper: Array, torque_limit: Array, zone: float, period_s: float = 1e-3) -> None:
        """Limits [rad] and torque limits [N m], shapes (7,); `zone` [rad], 0 switches the repulsion off.

        One torque comes every `period_s`.
        """
        cap = REPULSION_FRACTION * torque_limit
        gain = cap / zone**2 if zone > 0 else np.zeros_like(lower)
        self._zone = np.stack(((lower + upper) / 2, (upper - lower) / 2 - zone, gain, cap))
        self._limit = torque_limit
        self._rate = TORQUE_RATE_NM * period_s / 1e-3
        self._last = np.zeros_like(torque_limit)

    def reset(self) -> None:
        """Starts again from zero torque, as after a pause in which nothing was commanded."""
        self._last[:] = 0.0

    def torque(self, wanted: Array, q: Array, gravity: Array) -> Array:
        """The torque that may be commanded [N m], shape (7,), at joint positions `q` [rad], in place of the `wanted` one.

        It and it plus `gravity` are within limits. `wanted` is used up.
        """
        allowed = np.empty(len(wanted))
        kernel.safe(wanted, q, gravity, self._zone, self._limit, self._rate, self._last, allowed)
        return allowed
