"""What the sensors say about the contact: depth and force of the same moment."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from palpate_planning.kinematics import Kinematics
from palpate_planning.surface import Surface
from palpate_planning.timing import PERIOD_S
from palpate_planning.weight import ToolWeight

Array = NDArray[np.float64]

CONTACT_ON_N = 0.15
"""Normal force that counts as contact: nine standard deviations of the averaged noise."""
CONTACT_OFF_N = 0.08


@dataclass(frozen=True, slots=True)
class Reading:
    """Sensor values averaged over one planning period, so that force and depth belong together."""

    q: Array
    """Joint positions [rad], shape (7,)."""
    wrench_S: Array
    """Raw F/T reading, shape (6,)."""
    qd: Array
    """Joint velocities [rad/s], shape (7,)."""


@dataclass(frozen=True, slots=True)
class Contact:
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
        self._velocity: Array | None = None

    def sense(self, reading: Reading) -> Contact:
        """The contact at a reading."""
        X_WI, R_WS = self._kinematics.poses(reading.q)
        p_W, n_W, distance = self.surface.nearest(X_WI[:3, 3])
        velocity = (self._kinematics.jacobian(reading.q) @ reading.qd)[:3]
        acceleration = np.zeros(3) if self._velocity is None else (velocity - self._velocity) / PERIOD_S
        self._velocity = velocity
        force = float(self.weight.contact(R_WS, reading.wrench_S, acceleration) @ n_W)
        self._touching = force > (CONTACT_OFF_N if self._touching else CONTACT_ON_N)
        return Contact(X_WI, R_WS, p_W, n_W, self._radius - distance, force, self._touching)
