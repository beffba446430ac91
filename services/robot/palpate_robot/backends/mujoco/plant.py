"""The robot's physics in MuJoCo: an independent plant behind the same driver, sensors and messages.

Differences from the DART plant: the dynamics (composite rigid bodies in generalised coordinates instead of articulated bodies),
the step (two of 0.5 ms per tick), end stops and contacts (soft constraints with an impedance, solved as a convex problem, instead
of hard ones as an LCP), and the sensor (constraint wrench of the weld above the measuring face from a Newton-Euler pass).

The friction law is the scenario's and therefore the same: viscous, with a slope f / max(|v|, v_stick) for Coulomb friction.
MuJoCo's semi-implicit Euler method takes joint damping implicitly, (M + h D) a = M a_0, so neither can chatter. MuJoCo's
`frictionloss` is not
used: its solver weighs it with M instead of M + h D, as DART's does.

The model is built from the tables of the arm, as the URDF is. MuJoCo's URDF reader merges links that are fixed
to one another, and with them the F/T sensor's measuring face into the last link.
"""

from collections.abc import Sequence
from typing import Any, Final

import mujoco
import numpy as np

from palpate_models.numerics.frames import GRAVITY, Array
from palpate_models.robot.arm import TOOL, arm_of, base_pose, boxes, capsules, count_mounted, inertias, link_names
from palpate_models.robot.chain import Capsule, Inertia
from palpate_models.scenario.errors import DrawnArm
from palpate_models.scenario.schema import Robot
from palpate_robot.plant import DT, END_STOP_MARGIN_RAD, STICK_RADPS, Plant, Wrench

SUBSTEPS: Final = 2
"""Integration steps per millisecond: different from the DART plant, so that effects of the step size show."""
_ARM: Final = 1
_ENVIRONMENT: Final = 2
"""Collision groups: links collide with table and base, not with one another (planning avoids that)."""
_STOP: Final = (2 * DT / SUBSTEPS, 1.0)
"""Time constant [s] and damping ratio of end stops and contacts: the stiffest that MuJoCo allows at this step."""
_IMPEDANCE: Final = (0.999, 0.999, 0.001, 0.5, 2.0)
"""Fraction of the acceleration they remove. With MuJoCo's default 0.95, 30 N m push A7 (5e-4 kg m^2) 50 mrad into its stop."""


def _quaternion(rotation: Array) -> Array:
    """Return the unit quaternion (w, x, y, z) of a rotation matrix."""
    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, np.ascontiguousarray(rotation).ravel())
    return quaternion


def _add_link(parent: Any, link: str, position: tuple[float, float, float] | Array, inertia: Inertia) -> Any:
    body = parent.add_body(name=link, pos=position)
    body.explicitinertial = True
    body.mass = inertia.mass
    body.ipos = inertia.com
    body.fullinertia = [*inertia.diagonal, *inertia.products]
    return body


def _add_shape(body: Any, capsule: Capsule) -> None:
    shape: dict[str, Any] = {"contype": _ARM, "conaffinity": _ENVIRONMENT, "solref": _STOP, "solimp": _IMPEDANCE}
    if capsule.start == capsule.end:
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, pos=capsule.start, size=[capsule.radius, 0, 0], **shape)
    else:
        ends = [*capsule.start, *capsule.end]
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_CAPSULE, fromto=ends, size=[capsule.radius, 0, 0], **shape)


def build(robot: Robot, drawn: DrawnArm) -> Any:
    """Return the compiled model of the nominal `robot` with the arm errors `drawn`.

    Bodies have the names of the links; force and torque sensors are at the measuring face.
    """
    arm, X_WB = arm_of(robot), base_pose(robot)
    fixed: dict[str, Any] = {
        arm.link_names[-1]: arm.flange_m,
        "ft_sensor": (0.0, 0.0, TOOL.flange_to_ft_m),
        "indenter": (0.0, 0.0, TOOL.ft_to_indenter_m),
    }
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    spec.compiler.balanceinertia = False
    spec.option.timestep = DT / SUBSTEPS
    spec.option.gravity = (0.0, 0.0, -GRAVITY)
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_EULER
    for box in boxes(robot):
        spec.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=[edge / 2 for edge in box.size],
            pos=box.X_WB[:3, 3],
            quat=_quaternion(box.X_WB[:3, :3]),
            contype=_ENVIRONMENT,
            conaffinity=_ARM,
            solref=_STOP,
            solimp=_IMPEDANCE,
        )
    true = robot.model_copy(update={"tool_mass_kg": robot.tool_mass_kg * drawn.tool_mass})
    masses, shapes, at_base = inertias(true), capsules(robot), count_mounted(robot)
    body = spec.worldbody
    for i, link in enumerate(link_names(robot)):
        if i == 0:
            body = _add_link(body, link, X_WB[:3, 3], masses[link])
            body.quat = _quaternion(X_WB[:3, :3])
        elif link in fixed:
            body = _add_link(body, link, fixed[link], masses[link])
        else:
            body = _add_link(body, link, arm.origin_m[i - 1] + drawn.origin_m[i - 1], masses[link])
            body.add_joint(
                name=arm.joint_names[i - 1],
                type=mujoco.mjtJoint.mjJNT_HINGE,
                axis=arm.axis[i - 1],
                limited=True,
                range=(float(arm.lower_rad[i - 1]) - END_STOP_MARGIN_RAD, float(arm.upper_rad[i - 1]) + END_STOP_MARGIN_RAD),
                solref_limit=_STOP,
                solimp_limit=_IMPEDANCE,
            )
        for capsule in () if i < at_base else shapes[link]:
            _add_shape(body, capsule)
        if link == "ft_sensor":
            body.add_site(name="measuring_face")
    for name, kind in (("force", mujoco.mjtSensor.mjSENS_FORCE), ("moment", mujoco.mjtSensor.mjSENS_TORQUE)):
        spec.add_sensor(name=name, type=kind, objtype=mujoco.mjtObj.mjOBJ_SITE, objname="measuring_face")
    return spec.compile()


class MujocoPlant(Plant):
    """The arm with its tool."""

    def __init__(self, robot: Robot, drawn: DrawnArm, q: Sequence[float] | Array | None = None) -> None:
        """Create the nominal `robot` with the arm errors `drawn`, at rest at joint positions `q` [rad], by default at home."""
        arm = arm_of(robot)
        self._model = build(robot, drawn)
        self._data = mujoco.MjData(self._model)
        data = self._data
        # Permanent views: each access through MuJoCo costs 1 us.
        self._qpos, self._qvel, self._qacc = data.qpos, data.qvel, data.qacc
        self._joint_torque, self._joint_damping = data.qfrc_applied, self._model.dof_damping
        self._force_W = data.xfrc_applied[self._model.body("indenter").id, :3]
        self._moment_W = data.xfrc_applied[self._model.body("indenter").id, 3:]
        self._sensed, self._xpos, self._xquat = data.sensordata, data.xpos, data.xquat
        self._bodies = [self._model.body(link).id for link in link_names(robot)]
        self._base, self._indenter = self._bodies[0], self._bodies[-1]
        self._weight = GRAVITY * float(self._model.body_subtreemass[self._base])
        self._tool = self._model.body("ft_sensor").id
        self._uncompensated = GRAVITY * robot.tool_mass_kg * (drawn.tool_mass - 1)
        """Tool weight missing from the controller's load data [N]."""
        self._viscous = robot.joint_damping_nms * drawn.damping
        self._coulomb = robot.joint_friction_nm * drawn.friction
        self._jacobian = np.zeros((3, arm.joints))
        self._twist = np.zeros(6)
        self.reset(arm.home_rad if q is None else q)

    def reset(self, q: Sequence[float] | Array, v: Sequence[float] | Array | None = None) -> None:
        """Put the arm at joint positions `q` [rad] and velocities `v` [rad/s], by default at rest."""
        model, data = self._model, self._data
        mujoco.mj_resetData(model, data)
        self._qpos[:] = q
        self._qvel[:] = 0.0 if v is None else v
        mujoco.mj_fwdPosition(model, data)
        self._joint_torque[:] = self.gravity_torque()
        mujoco.mj_forward(model, data)  # so that the sensor reads the tool's weight before the first step
        self.q, self.v, self.friction = self._qpos.copy(), self._qvel.copy(), np.zeros_like(self._qvel)

    def step(self, torque: Array, force_W: Array | None, moment_W: Array, damping: Array) -> None:
        """See `Plant`. The sphere's centre is its centre of mass; `friction` is the mean of the step."""
        model, data, v = self._model, self._data, self._qvel
        self._joint_torque[:] = torque
        self._force_W[:] = 0.0 if force_W is None else force_W
        self._moment_W[:] = 0.0 if force_W is None else moment_W
        viscous = self._viscous + damping
        self.friction = np.zeros_like(self.v)
        for _ in range(SUBSTEPS):
            before = v.copy()
            self._joint_damping[:] = viscous + self._coulomb / np.maximum(np.abs(before), STICK_RADPS)
            mujoco.mj_fwdVelocity(model, data)
            mujoco.mj_step2(model, data)
            self.friction += self._joint_damping * v / SUBSTEPS
            # MuJoCo's sensors use the acceleration before implicit damping; the arm moved with the one after it.
            np.multiply(v - before, SUBSTEPS / DT, out=self._qacc)
            mujoco.mj_rnePostConstraint(model, data)
            mujoco.mj_sensorAcc(model, data)
            mujoco.mj_fwdPosition(model, data)
        mujoco.mj_comVel(model, data)
        self.q, self.v = self._qpos.copy(), v.copy()

    def gravity_torque(self) -> Array:
        """Return the joint torques that compensate gravity with the nominal tool [N m], shape (n,).

        The weight times the derivative of the centre of mass's height by each joint.
        """
        mujoco.mj_jacSubtreeCom(self._model, self._data, self._jacobian, self._base)
        torque = np.asarray(self._weight * self._jacobian[2])
        if self._uncompensated:
            mujoco.mj_jacSubtreeCom(self._model, self._data, self._jacobian, self._tool)
            torque -= self._uncompensated * self._jacobian[2]
        return torque

    def sensor_wrench(self) -> Wrench:
        """Return the wrench on the F/T sensor from the tool below it: force [N], then moment [N m].

        At the sensor's origin, in its axes, in the last half millisecond: contact, weight and inertia of the tool. MuJoCo's
        force and torque sensors read the wrench of the parent on the child.
        """
        fx, fy, fz, mx, my, mz = self._sensed.tolist()
        return -fx, -fy, -fz, -mx, -my, -mz

    def tool_motion(self) -> Array:
        """See `Plant`."""
        body, twist = self._indenter, self._twist
        mujoco.mj_objectVelocity(self._model, self._data, mujoco.mjtObj.mjOBJ_XBODY, body, twist, 0)
        quaternion = self._xquat[body]  # w first
        return np.concatenate((self._xpos[body], quaternion[1:], quaternion[:1], twist[3:], twist[:3]))

    def link_poses(self) -> Array:
        """See `Plant`."""
        quaternions = self._xquat[self._bodies]  # w first
        return np.column_stack((self._xpos[self._bodies], quaternions[:, 1:], quaternions[:, :1]))
