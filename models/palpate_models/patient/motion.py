"""Motion of the patient on the table during an examination: once, without moving back.

Marks of certainty: [A] assumed.
"""

import math
from typing import Annotated, Literal

import numpy as np
from pydantic import Field
from scipy.spatial.transform import Rotation

from palpate_models.numerics.frames import Array
from palpate_models.numerics.seeds import generator
from palpate_models.section import NonNegative, Section

_MIDDLE_S = (40.0, 90.0)
"""Range of the drawn time of motion [s]: within the scan of the default examination."""
_AXIS_BELOW_M = 0.10
"""Depth of the axis of rotation below the umbilicus [m] [A]: the spine."""


class Motion(Section):
    """Rigid motion of the whole body at one time. Sizes [A]: a shift of 5 to 20 mm, or a turn of 3 degrees."""

    kind: Literal["none", "shift", "turn"] = "none"
    """`shift`: along the table. `turn`: about the long axis. Direction and side are drawn from the seed."""
    shift_m: Annotated[float, Field(gt=0, le=0.02)] = 0.010
    """Distance of the shift."""
    turn_rad: Annotated[float, Field(gt=0, le=0.2)] = math.radians(3)
    """Angle of the turn."""
    at_s: NonNegative | None = None
    """Start of the motion; None: drawn from the seed, between 40 and 90 s."""
    over_s: Annotated[float, Field(ge=0.1, le=10)] = 0.5
    """Duration of the motion."""


class BodyMotion:
    """Pose of the body over time: A' is the moving frame of the body, A its frame before the motion.

    With s(x) = x^2 (3 - 2 x) from 0 to 1 over x = (t - at_s) / over_s, the body is shifted by s d, or turned by s theta about
    the line through p along e. Both are in A.
    """

    def __init__(self, motion: Motion, seed: int) -> None:
        """Equal settings and seed give an equal motion."""
        rng = generator(seed, "motion")
        middle, direction, side = rng.uniform(*_MIDDLE_S), rng.uniform(0, 2 * math.pi), rng.choice((-1.0, 1.0))
        self.at_s = float(middle) if motion.at_s is None else motion.at_s
        """Start [s]."""
        self.until_s = self.at_s + motion.over_s
        """End [s]."""
        self._d = np.zeros(3)
        self._theta = np.zeros(3)
        self._p = np.array((0.0, 0.0, -_AXIS_BELOW_M))
        if motion.kind == "shift":
            self._d = motion.shift_m * np.array((math.cos(direction), math.sin(direction), 0.0))
        elif motion.kind == "turn":
            self._theta = motion.turn_rad * np.array((0.0, side, 0.0))
        self.moves = motion.kind != "none"
        """True if there is a motion."""

    def pose(self, t_s: float) -> Array:
        """Return X_AA' at time `t_s` [s], shape (4, 4): the identity before the motion."""
        x = self._part(t_s)
        s = x * x * (3 - 2 * x)
        X = np.eye(4)
        X[:3, :3] = Rotation.from_rotvec(s * self._theta).as_matrix()
        X[:3, 3] = s * self._d + self._p - X[:3, :3] @ self._p
        return X

    def on_body(self, t_s: Array, p: Array) -> Array:
        """Return points of A [m], shape (k, 3), at times [s], shape (k,), expressed in A', shape (k, 3)."""
        if not self.moves:
            return p
        x = np.clip((t_s - self.at_s) / (self.until_s - self.at_s), 0.0, 1.0)
        s = (x * x * (3 - 2 * x))[:, None]
        return np.asarray(Rotation.from_rotvec(-s * self._theta).apply(p - s * self._d - self._p) + self._p)

    def twist(self, t_s: float) -> tuple[Array, Array]:
        """Return the body's velocity in A at time `t_s` [s]: v [m/s] and w [rad/s], shape (3,) each.

        A point of the body at r moves with v + w x r.
        """
        x = self._part(t_s)
        rate = 6 * x * (1 - x) / (self.until_s - self.at_s)
        w = rate * self._theta
        return rate * self._d - np.cross(w, self._p), w

    def _part(self, t_s: float) -> float:
        return min(max((t_s - self.at_s) / (self.until_s - self.at_s), 0.0), 1.0)
