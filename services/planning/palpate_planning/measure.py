"""What the sensors say about the contact: depth and force of the same moment."""

from __future__ import annotations

from math import isnan
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from palpate_models.compiled import compiled
from palpate_planning.kinematics import Kinematics
from palpate_planning.surface import Surface, foot
from palpate_planning.timing import PERIOD_S
from palpate_planning.weight import ToolWeight, external

Array = NDArray[np.float64]

CONTACT_ON_N = 0.15
"""Normal force that counts as contact: nine standard deviations of the averaged noise."""
CONTACT_OFF_N = 0.08


class Reading(NamedTuple):
    """Sensor values averaged over one planning period, so that force and depth belong together."""

    q: Array
    """Joint positions [rad], shape (7,)."""
    wrench_S: Array
    """Raw F/T reading, shape (6,)."""
    qd: Array
    """Joint velocities [rad/s], shape (7,)."""


class Contact(NamedTuple):
    """Measured contact."""

    X_WI: Array
    R_WS: Array
    p_W: Array
    """Rest surface point under the indenter [m], shape (3,)."""
    n_W: Array
    """Outward normal there."""
    depth: float
    """Radius less the signed distance of the sphere's centre from the rest surface [m]; negative: gap."""
    force: float
    """Normal force [N], positive when the tissue is pressed."""
    touching: bool


class ContactSense:
    """Turns readings into contact, against the surface perceived so far."""

    def __init__(self, kinematics: Kinematics, weight: ToolWeight, surface: Surface, radius: float) -> None:
        self.surface = surface
        self.weight = weight
        self._kinematics, self._radius = kinematics, radius
        self._touching = False
        self._velocity: Array = np.full(3, np.nan)
        """Of the sphere's centre at the reading before [m/s], world axes, shape (3,); NaN before the first."""

    def sense(self, reading: Reading) -> Contact:
        """The contact at a reading."""
        q, wrench_S, qd = reading
        kinematics, surface, weight = self._kinematics, self.surface, self.weight
        X_WI, R_WS = kinematics.poses(q)
        p_W, n_W, field = np.empty(3), np.empty(3), surface.field
        distance, force = _press(
            X_WI, surface.frames, field.axes, field.coefficients, surface.offset,
            kinematics.jacobian(q), qd, R_WS, wrench_S, weight.bias, weight.weight_W, weight.mass, self._velocity, p_W, n_W,
        )  # fmt: skip
        self._touching = force > (CONTACT_OFF_N if self._touching else CONTACT_ON_N)
        return Contact(X_WI, R_WS, p_W, n_W, self._radius - distance, force, self._touching)


@compiled
def _press(
    X_WI: Array,
    frames: Array,
    axes: Array,
    coefficients: Array,
    offset: float,
    J: Array,
    qd: Array,
    R_WS: Array,
    wrench_S: Array,
    bias_S: Array,
    weight_W: Array,
    mass: float,
    velocity: Array,
    p_W: Array,
    n_W: Array,
) -> tuple[float, float]:
    """Signed distance [m] of the centre from the surface, as `foot` has it, and normal force [N], as `external` has it.

    `velocity` of the centre a period before [m/s], world axes, shape (3,), NaN for none, becomes that of now; p_W and n_W are
    filled in.
    """
    c_W = np.array((X_WI[0, 3], X_WI[1, 3], X_WI[2, 3]))
    distance = foot(frames, axes, coefficients, offset, c_W, p_W, n_W)
    V_WI = J @ qd
    a_W = np.zeros(3)
    for i in range(3):
        if not isnan(velocity[i]):
            a_W[i] = (V_WI[i] - velocity[i]) / PERIOD_S
        velocity[i] = V_WI[i]
    force = external(R_WS, wrench_S, bias_S, weight_W, mass, a_W)
    return distance, float(force @ n_W)
