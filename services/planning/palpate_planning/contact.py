"""What the sensors say about the contact: depth and force of the same moment."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from palpate_models.numerics.frames import Array
from palpate_planning.kinematics import ArmKinematics
from palpate_planning.surface import Foot
from palpate_planning.tool_weight import ToolWeight
from palpate_planning.wall import Wall, WallPlace

CONTACT_ON_N = 0.3
"""Normal force that counts as contact: more than noise and the drift since the last tare."""
CONTACT_OFF_N = 0.15
"""Contact ends below this normal force."""


class SensorReading(NamedTuple):
    """Sensor values averaged over one planning period, so that force and depth belong together."""

    q: Array
    """Joint positions [rad], shape (7,)."""
    wrench_S: Array
    """Raw reading of the force/torque sensor, in its axes, force [N] then torque [N m], shape (6,)."""
    qd: Array
    """Joint velocities [rad/s], shape (7,)."""


class ContactMeasurement(NamedTuple):
    """Measured contact."""

    q: Array
    """Joint positions [rad], shape (7,)."""
    X_WI: Array
    """Pose of the indenter, shape (4, 4)."""
    R_WS: Array
    """Orientation of the force/torque sensor, shape (3, 3)."""
    foot: Foot
    """The point of the perceived surface under the indenter."""
    wall: WallPlace
    """Where the skin is outward of it; its standard deviation is that of the depth."""
    depth: float
    """Radius less the signed distance of the sphere's centre from the unpressed skin, where it is now [m]; negative: gap."""
    force: float
    """Normal force [N], positive when the tissue is pressed."""
    load: float
    """Size of the whole force, normal and sideways [N]."""
    skin: tuple[Array, Array]
    """The point of the skin under the indenter and its outward normal, where the first look saw them (`Wall.skin`)."""
    touching: bool
    """Whether the tissue is felt; before the first tare the sensor's bias would pass for it, and nothing is."""


class ContactSensing:
    """Turns sensor readings into contact with the wall as it is believed to be."""

    def __init__(self, kinematics: ArmKinematics, weight: ToolWeight, wall: Wall, radius: float, period_s: float) -> None:
        """`radius` of the sphere [m]; a reading comes every `period_s`."""
        self.wall = wall
        self.weight = weight
        self._kinematics, self._radius, self._period_s = kinematics, radius, period_s
        self._touching = False
        self._velocity: Array | None = None
        """Velocity of the sphere's centre at the reading before [m/s], world axes, shape (3,)."""

    def sense(self, reading: SensorReading, t: int) -> ContactMeasurement:
        """The contact at the reading of time `t` [ns]."""
        X_WI, R_WS = self._kinematics.poses(reading.q)
        wall, foot = self.wall, self.wall.perceived.nearest(X_WI[:3, 3])
        place = wall.at(foot.xy_A, t)
        velocity = self._kinematics.jacobian(reading.q)[:3] @ reading.qd
        acceleration = np.zeros(3) if self._velocity is None else (velocity - self._velocity) / self._period_s
        self._velocity = velocity
        force_W = self.weight.contact(R_WS, reading.wrench_S, acceleration)
        force = float(force_W @ foot.n_W)
        self._touching = self.weight.tared and force > (CONTACT_OFF_N if self._touching else CONTACT_ON_N)
        return ContactMeasurement(
            reading.q,
            X_WI,
            R_WS,
            foot,
            place,
            self._radius - foot.distance + place.correction + place.displacement,
            force,
            float(np.linalg.norm(force_W)),
            wall.skin(foot, place.correction),
            self._touching,
        )
