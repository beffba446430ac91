"""The driver's checks of each tick, compiled: whether all is well. What is not, and with which joint, is found out afterwards."""

from __future__ import annotations

from palpate_models.compiled import compiled
from palpate_models.frames import Array


@compiled
def within(q: Array, v: Array, position_limit: Array, velocity_limit: Array) -> bool:
    """Whether positions and velocities, shapes (7,), are numbers and at most their limits in size."""
    good = True
    for j in range(q.shape[0]):
        good = good and abs(q[j]) <= position_limit[j] and abs(v[j]) <= velocity_limit[j]
    return good


@compiled
def obeyable(torque: Array, gravity: Array, before: Array, limit: Array, change: float) -> bool:
    """Whether a command (7,), gravity added, is within its limit and no more than `change` away from the one before [N m]."""
    good = True
    for j in range(torque.shape[0]):
        good = good and abs(torque[j] + gravity[j]) <= limit[j] and abs(torque[j] - before[j]) <= change
    return good
