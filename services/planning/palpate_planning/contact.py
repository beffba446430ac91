"""Contact force from the force/torque sensor: bias by taring in free air, weight of the tool from its orientation.

The sensor S reads, in its own axes, F_S = R_SW (F_contact + m (g - a)) + bias. With the mass known, the bias is the mean of
F_S - R_SW m g at rest while nothing is touched, in whatever orientations. Torques are not used.
"""

from typing import NamedTuple

import numpy as np

from palpate_models.numerics.frames import GRAVITY, Array
from palpate_models.robot.arm import inertias
from palpate_models.scenario.schema import Robot
from palpate_planning.motion.kinematics import ArmKinematics
from palpate_planning.periods import SECOND
from palpate_planning.wall.surface import Foot
from palpate_planning.wall.wall import Wall, WallEstimate


class ForceCompensation:
    """Removes the sensor's bias and the tool's weight and inertia from its readings."""

    def __init__(self, mass: float) -> None:
        """`mass` [kg] below the sensor."""
        self.mass = mass
        self.weight_W: Array = np.array((0.0, 0.0, -mass * GRAVITY))
        """[N], world axes, shape (3,)."""
        self.bias = np.zeros(3)
        """Reading of the sensor without force [N], in its axes, shape (3,)."""
        self.tared = False
        """True once the bias has been measured."""
        self._sum, self._count = np.zeros(3), 0

    def weight_S(self, R_WS: Array) -> Array:
        """Return the weight in the sensor's axes [N], shape (3,)."""
        return np.asarray(R_WS.T @ self.weight_W)

    def update(self, R_WS: Array, wrench_S: Array, *, taring: bool) -> None:
        """Include a reading in free air, force and torque, shape (6,), in the bias. A tare ends with a call without `taring`."""
        if not taring:
            self._sum, self._count = np.zeros(3), 0
            return
        self._sum += wrench_S[:3] - self.weight_S(R_WS)
        self._count += 1
        self.tared = True
        self.bias = self._sum / self._count

    def contact_force_W(self, R_WS: Array, wrench_S: Array, a_W: Array) -> Array:
        """Return the force of the environment on the tool [N], world axes, shape (3,).

        `a_W`: acceleration of the tool [m/s^2], shape (3,). Without it 0.5 m/s^2 at 0.35 kg would read as 0.18 N, above `off_n`.
        """
        return np.asarray(R_WS @ (wrench_S[:3] - self.bias) - self.weight_W + self.mass * a_W)


class ContactThresholds(NamedTuple):
    """Contact force at which contact begins and ends."""

    on_n: float = 0.3
    """Normal force that counts as contact: more than noise and the drift since the last tare."""
    off_n: float = 0.15
    """Contact ends below this normal force."""
    joints_n: float = 3.0
    """Maximum error of the force by the joints: beyond it they feel a contact."""


THRESHOLDS = ContactThresholds()


class SensorReading(NamedTuple):
    """Sensor values averaged over one planning period, so that force and depth belong together."""

    stamp: int
    """Time at the end of the period [ns]."""
    q: Array
    """Joint positions [rad], shape (n,)."""
    wrench_S: Array
    """Raw reading of the force/torque sensor, in its axes, force [N] then torque [N m], shape (6,)."""
    qd: Array
    """Joint velocities [rad/s], shape (n,)."""


class ContactMeasurement(NamedTuple):
    """Measured contact."""

    q: Array
    """Joint positions [rad], shape (n,)."""
    X_WI: Array
    """Pose of the indenter, shape (4, 4)."""
    R_WS: Array
    """Orientation of the force/torque sensor, shape (3, 3)."""
    foot: Foot
    """The point of the perceived surface under the indenter."""
    wall: WallEstimate
    """Height of the wall above it; its standard deviation is that of the depth."""
    depth: float
    """Radius less the signed distance of the sphere's centre from the present unpressed wall [m]; negative: gap."""
    force: float
    """Normal force [N], positive when the tissue is pressed."""
    load: float
    """Magnitude of the whole force, normal and lateral [N]: the larger of F/T sensor and joints, less the joints' error."""
    wall_point: tuple[Array, Array]
    """Point of the wall under the indenter and its outward normal, in the frame of the first view (`Wall.point`)."""
    touching: bool
    """True in contact by the F/T sensor; False before the first tare, when the sensor's bias would look like contact."""
    joints_only: bool = False
    """True if the joint torques show a contact and the F/T sensor does not."""


class ContactSensing:
    """Computes the contact with the estimated wall from sensor readings."""

    def __init__(self, kinematics: ArmKinematics, robot: Robot, wall: Wall) -> None:
        self.wall = wall
        self.compensation = ForceCompensation(sum(inertias(robot)[link].mass for link in ("ft_sensor", "indenter")))
        self._kinematics, self._radius = kinematics, robot.indenter_radius_m
        self._touching = False
        self._before: tuple[int, Array] | None = None
        """Stamp [ns] of the latest reading, and the velocity of the sphere's centre then [m/s], world axes, shape (3,)."""
        self._acceleration = np.zeros(3)

    def sense(self, reading: SensorReading, t: int, joint_force: float = 0.0) -> ContactMeasurement:
        """Return the contact at the reading of time `t` [ns]; `joint_force`: force at the tool by the joints alone [N]."""
        X_WI, R_WS = self._kinematics.poses(reading.q)
        wall, foot = self.wall, self.wall.perceived.nearest(X_WI[:3, 3])
        place = wall.at(foot.xy_A, t)
        velocity = self._kinematics.jacobian(reading.q)[:3] @ reading.qd
        if self._before is not None and reading.stamp > self._before[0]:  # else the latest reading once more
            self._acceleration = (velocity - self._before[1]) / ((reading.stamp - self._before[0]) / SECOND)
        self._before = reading.stamp, velocity
        force_W = self.compensation.contact_force_W(R_WS, reading.wrench_S, self._acceleration)
        force = float(force_W @ foot.n_W)
        self._touching = self.compensation.tared and force > (THRESHOLDS.off_n if self._touching else THRESHOLDS.on_n)
        load, by_joints = float(np.linalg.norm(force_W)), joint_force - THRESHOLDS.joints_n
        depth = self._radius - foot.distance + place.correction + place.displacement
        point, joints_only = wall.point(foot, place.correction), by_joints > 0.0 and not self._touching
        return ContactMeasurement(
            reading.q, X_WI, R_WS, foot, place, depth, force, max(load, by_joints), point, self._touching, joints_only
        )
