"""Limits on the torque of any control law: repulsion from joint limits, saturation, and a rate limit."""

import numpy as np

from palpate_models.numerics.compiled import compiled
from palpate_models.numerics.frames import Array

TORQUE_RATE_NM_PER_MS = 1.0
"""Maximum change of a joint's torque in one millisecond [N m] (libfranka and CRISP bound it to 0.5 to 1.0)."""
REPULSION_FRACTION = 0.3
"""Repulsion at a joint limit, as a fraction of the joint's torque limit."""


class SafetyNet:
    """Adds repulsion from joint limits and limits torque and torque rate.

    The repulsion is a progressive spring in the last `zone` before each joint limit: conservative, and smooth at the edge of the
    zone. Saturation includes gravity. The change from tick to tick is bounded.
    """

    def __init__(self, lower: Array, upper: Array, torque_limit: Array, zone: float, period_s: float) -> None:
        """Take joint limits [rad] and torque limits [N m], shapes (n,); `zone` [rad] (0: no repulsion); one torque per
        `period_s`.
        """
        gain = REPULSION_FRACTION * torque_limit / zone**2 if zone > 0 else np.zeros_like(lower)
        self._joints = np.stack(((lower + upper) / 2, (upper - lower) / 2 - zone, gain, torque_limit))
        self.peak = np.zeros_like(torque_limit)
        """Largest magnitude of each torque so far [N m], shape (n,)."""
        self._rate = TORQUE_RATE_NM_PER_MS * period_s / 1e-3
        self._last = np.zeros_like(torque_limit)

    def reset(self) -> None:
        """Restart from zero torque, as after a pause without commands."""
        self._last = np.zeros_like(self._last)

    def torque(self, wanted: Array, q: Array, gravity: Array) -> Array:
        """Return the torque to command instead of `wanted` [N m], shape (n,), at joint positions `q` [rad].

        The torque, and the torque plus `gravity`, are within limits.
        """
        safe = np.empty(len(q))
        safe_torque(wanted, q, gravity, self._last, self._rate, self._joints, self.peak, safe)
        self._last = safe
        return safe


@compiled
def safe_torque(
    wanted: Array, q: Array, gravity: Array, last: Array, rate: float, joints: Array, peak: Array, safe: Array
) -> None:
    """Set `safe` [N m], shape (n,), to `wanted` plus repulsion from joint limits, within all limits; keep the `peak` magnitude.

    It is within the torque limits, also with `gravity` added, and within `rate` of `last` [N m]. Rows of `joints`: middle of each
    joint range [rad], angle from it at which the repulsion begins [rad], its gain [N m/rad^2], torque limit [N m].
    """
    middle, free, gain, limit = joints[0], joints[1], joints[2], joints[3]
    off = q - middle
    depth = np.maximum(np.abs(off) - free, 0.0)
    repulsion = np.minimum(gain * depth**2, REPULSION_FRACTION * limit)
    low = np.maximum(np.maximum(-limit, -limit - gravity), last - rate)
    high = np.minimum(np.minimum(limit, limit - gravity), last + rate)
    safe[:] = np.minimum(np.maximum(wanted - np.sign(off) * repulsion, low), high)
    peak[:] = np.maximum(peak, np.abs(safe))
