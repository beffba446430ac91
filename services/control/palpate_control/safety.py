"""What keeps any law's torque safe: repulsion from joint limits, saturation, and a bound on its rate."""

from __future__ import annotations

import numpy as np

from palpate_models.numerics.compiled import compiled
from palpate_models.numerics.frames import Array

TORQUE_RATE_NM = 1.0
"""Largest change of a joint's torque in one millisecond [N m] (libfranka and CRISP bound it to 0.5 to 1.0)."""
REPULSION_FRACTION = 0.3
"""Repulsion at a joint limit, as a fraction of the joint's torque limit."""


class SafetyNet:
    """Between any law and the arm: torques away from joint limits, within the joints' limits, and without jumps.

    The repulsion is a progressive spring in the last `zone` before each joint limit: conservative, and smooth at the zone's edge.
    Torques saturate with gravity counted in. Their change from tick to tick is bounded.
    """

    def __init__(self, lower: Array, upper: Array, torque_limit: Array, zone: float, period_s: float) -> None:
        """Limits [rad] and torque limits [N m], shapes (7,); `zone` [rad], 0 switches the repulsion off.

        One torque comes every `period_s`.
        """
        gain = REPULSION_FRACTION * torque_limit / zone**2 if zone > 0 else np.zeros_like(lower)
        self._joints = np.stack(((lower + upper) / 2, (upper - lower) / 2 - zone, gain, torque_limit))
        self._rate = TORQUE_RATE_NM * period_s / 1e-3
        self._last = np.zeros_like(torque_limit)

    def reset(self) -> None:
        """Starts again from zero torque, as after a pause in which nothing was commanded."""
        self._last = np.zeros_like(self._last)

    def torque(self, wanted: Array, q: Array, gravity: Array) -> Array:
        """The torque that may be commanded [N m], shape (7,), at joint positions `q` [rad], in place of the `wanted` one.

        It and it plus `gravity` are within limits.
        """
        safe = np.empty_like(self._last)
        safe_torque(wanted, q, gravity, self._last, self._rate, self._joints, safe)
        self._last = safe
        return safe


@compiled
def safe_torque(wanted: Array, q: Array, gravity: Array, last: Array, rate: float, joints: Array, safe: Array) -> None:
    """Sets `safe` [N m], shape (7,): it pushes away from the joint limits, else is as `wanted`, within all limits.

    It is within the torque limits, also with `gravity` added, and within `rate` of `last` [N m]. The rows of `joints` are the
    middle of the joints' ranges [rad], the angle from it at which the repulsion begins [rad], its gain [N m/rad^2] and the torque
    limits [N m].
    """
    middle, free, gain, limit = joints[0], joints[1], joints[2], joints[3]
    off = q - middle
    depth = np.maximum(np.abs(off) - free, 0.0)
    repulsion = np.minimum(gain * depth**2, REPULSION_FRACTION * limit)
    low = np.maximum(np.maximum(-limit, -limit - gravity), last - rate)
    high = np.minimum(np.minimum(limit, limit - gravity), last + rate)
    safe[:] = np.minimum(np.maximum(wanted - np.sign(off) * repulsion, low), high)
