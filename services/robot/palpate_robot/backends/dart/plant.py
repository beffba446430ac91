"""The robot's physics in DART: rigid-body dynamics with joint friction, end stops, and contact with table and base.

DART integrates semi-implicitly at 1 ms: accelerations by articulated bodies with implicit joint damping, end stops and contacts
as velocity constraints, then positions with the new velocity.

    (M + dt D(v)) a = tau - h(q, v) - D(v) v + J' F,    D(v) = d + f / max(|v|, v_stick),    v += dt a,    q += dt v

with viscous damping d and Coulomb friction f of each joint. Friction is implicit and can neither chatter nor add energy. DART's
own Coulomb constraint is not used: it stops a joint with the inertia M instead of M + dt D, so 0.1 N m of friction on A7 (5e-4 kg
m^2, 10 N m s/rad) sticks up to 2.1 N m.

Collision detection takes more than half of DART's step. While nothing is within reach (`Clearance`) the step skips it; the result
is identical to the bit.
"""

import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import dartpy as dart
import numpy as np

from palpate_errors import RunError
from palpate_models.numerics.frames import GRAVITY, Array, rigid
from palpate_models.robot.arm import Box, arm_of, boxes, capsules, count_mounted, link_names, urdf
from palpate_models.robot.chain import Capsule
from palpate_models.scenario.errors import DrawnArm
from palpate_models.scenario.schema import Robot
from palpate_robot.kinematics import Kinematics
from palpate_robot.plant import DT, END_STOP_MARGIN_RAD, STICK_RADPS, Plant, Wrench


class ClearanceTuning(NamedTuple):
    """When the step skips collision detection."""

    reach_m: float = 1.5
    """Maximum distance of any point of arm and tool from a joint axis: points move slower than this times sum |v|."""
    min_rad: float = 0.01
    """Clearance below which DART detects collisions: much more than the joints turn in a step."""
    check_every: int = 20
    """Steps between checks while the clearance is too small."""


CLEARANCE: Final = ClearanceTuning()


class Clearance:
    """Lower bound on the joint travel before a capsule can reach a box or a joint its stop."""

    def __init__(
        self,
        links: Mapping[str, Any],
        shapes: Mapping[str, tuple[Capsule, ...]],
        boxes: tuple[Box, ...],
        stops: tuple[Array, Array],
    ):
        """Take DART bodies and capsules by link, the boxes, and lower and upper joint stops [rad], shapes (n,)."""
        pairs = [(links[name], capsule) for name, parts in shapes.items() for capsule in parts]
        self._bodies = [body for body, _ in pairs]
        ends = np.array([(capsule.start, capsule.end) for _, capsule in pairs])
        self._ends: Array = np.concatenate((ends, np.ones((*ends.shape[:2], 1))), axis=2)  # (n, 2, 4)
        self._radii = np.array([capsule.radius for _, capsule in pairs])
        self._X_BW = np.array([np.linalg.inv(box.X_WB) for box in boxes])
        self._half = np.array([box.size for box in boxes]) / 2
        self._lowest, self._highest = stops

    def angle(self, q: Array) -> float:
        """Return the sum of |angles| [rad] that joints may turn from `q` before one can reach a stop or box; may be negative."""
        X_WL = np.array([body.getWorldTransform().matrix() for body in self._bodies])
        ends_W = self._ends @ X_WL.transpose(0, 2, 1)
        ends_B = np.einsum("bij,nkj->bnki", self._X_BW, ends_W)[..., :3]
        # bounding boxes of the capsules, axis by axis
        gap = np.maximum(ends_B.min(axis=2), -ends_B.max(axis=2)) - self._half[:, None, :]
        distance = np.linalg.norm(np.maximum(gap, 0.0), axis=2) - self._radii
        return min(float(distance.min()) / CLEARANCE.reach_m, float(np.minimum(self._highest - q, q - self._lowest).min()))


def _isometry(X: Array) -> Any:
    return dart.math.Isometry3(X)


def _pose_along(start: Array, end: Array) -> Array:
    """Return the pose, shape (4, 4), half-way from start to end with z along that direction."""
    z = (end - start) / np.linalg.norm(end - start)
    x = np.cross((0.0, 1.0, 0.0), z) if abs(z[1]) < 0.9 else np.cross((1.0, 0.0, 0.0), z)
    x /= np.linalg.norm(x)
    return rigid(np.column_stack((x, np.cross(z, x), z)), (start + end) / 2)


def _add_shape(body: Any, shape: Any, X: Array) -> None:
    node = body.createShapeNode(shape)
    node.createCollisionAspect()
    node.createDynamicsAspect()
    node.setRelativeTransform(_isometry(X))


def _load_arm(robot: Robot) -> Any:
    """Return the arm as a DART skeleton without shapes. DART's loader needs an absolute file path."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder).resolve() / "robot.urdf"
        path.write_text(urdf(robot, geometry=False), encoding="utf-8")
        skeleton = dart.utils.DartLoader().parseSkeleton(str(path))
    if skeleton is None or skeleton.getNumDofs() != arm_of(robot).joints:
        raise RunError(f"DART could not load the robot's URDF with {arm_of(robot).joints} joints")
    return skeleton


def _environment(robot: Robot) -> Any:
    """Return table and base as one immobile skeleton."""
    skeleton = dart.dynamics.Skeleton("environment")
    _, body = skeleton.createWeldJointAndBodyNodePair()
    for box in boxes(robot):
        _add_shape(body, dart.dynamics.BoxShape(box.size), box.X_WB)
    skeleton.setMobile(False)
    return skeleton


class DartPlant(Plant):
    """The arm with its tool."""

    def __init__(self, robot: Robot, drawn: DrawnArm, q: Sequence[float] | Array | None = None) -> None:
        """Create the nominal `robot` with the arm errors `drawn`, at rest at joint positions `q` [rad], by default at home."""
        arm = arm_of(robot)
        joints = slice(1, 1 + arm.joints)
        self._arm = _load_arm(robot.model_copy(update={"tool_mass_kg": robot.tool_mass_kg * drawn.tool_mass}))
        for joint, origin, error in zip(self._arm.getJoints()[joints], arm.origin_m, drawn.origin_m, strict=True):
            joint.setTransformFromParentBodyNode(_isometry(rigid(np.eye(3), origin + error)))
        self._set_damping = tuple(self._arm.getDof(i).setDampingCoefficient for i in range(arm.joints))
        stops = (arm.lower_rad - END_STOP_MARGIN_RAD, arm.upper_rad + END_STOP_MARGIN_RAD)
        for joint, lowest, highest in zip(self._arm.getJoints()[joints], *stops, strict=True):
            joint.setPositionLowerLimit(0, lowest)
            joint.setPositionUpperLimit(0, highest)
            joint.setVelocityLowerLimit(0, -np.inf)  # no physical speed limit: the driver checks it
            joint.setVelocityUpperLimit(0, np.inf)
            joint.setLimitEnforcement(True)
            joint.setCoulombFriction(0, 0.0)
        shapes = dict(list(capsules(robot).items())[count_mounted(robot) :])
        for link, parts in shapes.items():
            for capsule in parts:
                self._add_capsule(self._arm.getBodyNode(link), capsule)
        self._world = dart.simulation.World()
        self._world.setTimeStep(DT)
        self._world.setGravity([0.0, 0.0, -GRAVITY])
        deactivation = self._world.getDeactivationOptions()
        deactivation.mEnabled = False  # DART would put bodies slower than 1 cm/s to sleep, and palpation is slower
        self._world.setDeactivationOptions(deactivation)
        # DART's own detector is exact for capsules and boxes and the cheapest here; FCL has no capsules.
        self._world.getConstraintSolver().setCollisionDetector(dart.collision.DARTCollisionDetector())
        self._world.addSkeleton(self._arm)
        self._world.addSkeleton(_environment(robot))
        self._links = {link: self._arm.getBodyNode(link) for link in link_names(robot)}
        self._sensor = self._links["ft_sensor"]
        self._indenter = self._links["indenter"]
        self._kinematics = Kinematics(robot, drawn.origin_m)
        self._clearance = Clearance(self._links, shapes, boxes(robot), stops)
        self._free_travel = 0.0  # sum of angles [rad] that the joints may turn before a contact is possible
        self._check_in = 0  # steps until the next clearance check
        self._viscous = robot.joint_damping_nms * drawn.damping
        self._coulomb = robot.joint_friction_nm * drawn.friction
        self._cached_state: Array | None = None
        self.reset(arm.home_rad if q is None else q)

    @staticmethod
    def _add_capsule(body: Any, capsule: Capsule) -> None:
        start, end = np.array(capsule.start), np.array(capsule.end)
        length = float(np.linalg.norm(end - start))
        if length > 0:
            _add_shape(body, dart.dynamics.CapsuleShape(capsule.radius, length), _pose_along(start, end))
        else:
            _add_shape(body, dart.dynamics.SphereShape(capsule.radius), rigid(np.eye(3), start))

    def reset(self, q: Sequence[float] | Array, v: Sequence[float] | Array | None = None) -> None:
        """Put the arm at joint positions `q` [rad] and velocities `v` [rad/s], by default at rest."""
        self._arm.setPositions(np.asarray(q, dtype=float))
        self._arm.setVelocities(np.zeros(self._arm.getNumDofs()) if v is None else np.asarray(v, dtype=float))
        self.q, self.v = self._arm.getPositions(), self._arm.getVelocities()
        self.friction = np.zeros_like(self.v)
        self._cached_state = None
        self._arm.setForces(self.gravity_torque())
        self._arm.computeForwardDynamics()  # so that the sensor reads the tool's weight before the first step
        self._free_travel, self._check_in = 0.0, 0

    def step(self, torque: Array, force_W: Array | None, moment_W: Array, damping: Array) -> None:
        """See `Plant`."""
        slopes = self._viscous + damping + self._coulomb / np.maximum(np.abs(self.v), STICK_RADPS)
        for set_damping, slope in zip(self._set_damping, slopes.tolist(), strict=True):
            set_damping(slope)
        self._arm.setForces(torque)
        if force_W is not None:
            self._indenter.addExtForce(force_W)  # at its origin, in world axes
            self._indenter.addExtTorque(moment_W, False)
        if self._is_clear():
            arm = self._arm
            arm.computeForwardDynamics()
            arm.integrateVelocities(DT)
            arm.integratePositions(DT)
            arm.clearInternalForces()
            if force_W is not None:
                arm.clearExternalForces()
        else:
            self._world.step()  # clears torques and external forces, too
        self.q, self.v = self._arm.getPositions(), self._arm.getVelocities()
        self.friction = slopes * self.v
        self._cached_state = None

    def _is_clear(self) -> bool:
        """Return True if no contact is possible during the coming step."""
        self._free_travel -= sum(map(abs, self.v.tolist())) * DT
        if self._free_travel > CLEARANCE.min_rad:
            return True
        if self._check_in:
            self._check_in -= 1
            return False
        self._free_travel = self._clearance.angle(self.q)
        clear = self._free_travel > CLEARANCE.min_rad
        self._check_in = 0 if clear else CLEARANCE.check_every
        return clear

    def gravity_torque(self) -> Array:
        """See `Plant`."""
        return self._state()[13:]

    def _state(self) -> Array:
        """Return `Kinematics.state`, computed once per step."""
        if self._cached_state is None:
            self._cached_state = self._kinematics.state(self.q, self.v)
        return self._cached_state

    def sensor_wrench(self) -> Wrench:
        """Return the wrench on the F/T sensor from the tool below it: force [N], then moment [N m].

        At the sensor's origin, in its axes, averaged over the last step: contact, weight and inertia of the tool. It is minus the
        wrench that the joint above `ft_sensor` transmits (Featherstone's f_i), constraints included.
        """
        mx, my, mz, fx, fy, fz = self._sensor.getBodyForce().tolist()
        return -fx, -fy, -fz, -mx, -my, -mz

    def tool_motion(self) -> Array:
        """See `Plant`."""
        return self._state()[:13]

    def link_poses(self) -> Array:
        """See `Plant`."""
        return self._kinematics.links(self.q)
