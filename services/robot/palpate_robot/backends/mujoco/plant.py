"""The robot's physics in MuJoCo: an independent plant behind the same driver, sensor and messages.

What differs from the plant in DART: the dynamics (composite rigid bodies in generalised coordinates, not articulated bodies),
the step (two of 0.5 ms a tick), end stops and contacts (soft constraints with an impedance, solved as a convex problem, not
hard ones as an LCP), and the sensor (constraint wrench of the weld above the measuring face from a Newton-Euler pass).

The law of friction is the scenario's and so the same: viscous, with a slope f / max(|v|, v_stick) for Coulomb friction. MuJoCo's
semi-implicit Euler method takes joint damping implicitly, (M + h D) a = M a_0, so neither can chatter. Its own `frictionloss` is
not used: its solver weighs it with M instead of M + h D, as DART's does.
"""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np

from palpate_models.numerics.frames import Array
from palpate_models.numerics.gravity import GRAVITY
from palpate_models.robot import lbr
from palpate_models.scenario.errors import DrawnArm
from palpate_models.scenario.schema import Robot
from palpate_robot.backends.mujoco.model import SUBSTEPS, build
from palpate_robot.plant import DT, NOMINAL_ARM, STICK_RADPS, Wrench


class MujocoPlant:
    """The arm with its tool. Arrays of joints have shape (7,), order lbr_A1..lbr_A7; units N, N m, m, rad, s."""

    def __init__(self, robot: Robot, q: Sequence[float] | Array = lbr.HOME, drawn: DrawnArm = NOMINAL_ARM) -> None:
        """The nominal `robot` with an arm that differs from it as `drawn` says, at rest at joint positions `q` [rad]."""
        self._model = build(robot, drawn)
        self._data = mujoco.MjData(self._model)
        data = self._data
        self._qpos, self._qvel, self._qacc = data.qpos, data.qvel, data.qacc  # views, for life: to ask MuJoCo for one costs 1 us
        self._joint_torque, self._joint_damping = data.qfrc_applied, self._model.dof_damping
        self._force_W = data.xfrc_applied[self._model.body("indenter").id, :3]
        self._moment_W = data.xfrc_applied[self._model.body("indenter").id, 3:]
        self._sensed, self._xpos, self._xquat = data.sensordata, data.xpos, data.xquat
        self._bodies = [self._model.body(link).id for link in lbr.LINK_NAMES]
        self._base, self._indenter = self._bodies[0], self._bodies[-1]
        self._weight = GRAVITY * float(self._model.body_subtreemass[self._base])
        self._tool = self._model.body("ft_sensor").id
        self._forgotten = GRAVITY * robot.tool_mass_kg * (drawn.tool_mass - 1)
        """Weight of the tool [N] that is not in the controller's load data."""
        self._viscous = robot.joint_damping_nms * drawn.damping
        self._coulomb = robot.joint_friction_nm * drawn.friction
        self._jacobian = np.zeros((3, 7))
        self._twist = np.zeros(6)
        self._contacts = 0
        self.q: Array
        """Joint positions [rad], a fresh array at every step."""
        self.v: Array
        """Joint velocities [rad/s], a fresh array at every step."""
        self.reset(q)

    def reset(self, q: Sequence[float] | Array, v: Sequence[float] | Array | None = None) -> None:
        """Puts the arm at joint positions `q` [rad] and velocities `v` [rad/s], by default at rest."""
        model, data = self._model, self._data
        mujoco.mj_resetData(model, data)
        self._qpos[:] = q
        self._qvel[:] = 0.0 if v is None else v
        mujoco.mj_fwdPosition(model, data)
        self._joint_torque[:] = self.gravity_torque()
        mujoco.mj_forward(model, data)  # so that the sensor reads the tool's weight before the first step
        self.q, self.v = self._qpos.copy(), self._qvel.copy()

    def step(self, torque: Array, force_W: Array | None, moment_W: Array, damping: Array) -> None:
        """Advances 1 ms under joint torques (gravity not compensated), the driver's damping, and a wrench on the indenter.

        `damping` [N m s/rad], shape (7,), comes on top of the friction. The wrench, shapes (3,), acts at the sphere's
        centre (its centre of mass), in world axes, and is held over the step.
        """
        model, data, v = self._model, self._data, self._qvel
        self._joint_torque[:] = torque
        self._force_W[:] = 0.0 if force_W is None else force_W
        self._moment_W[:] = 0.0 if force_W is None else moment_W
        viscous = self._viscous + damping
        for _ in range(SUBSTEPS):
            before = v.copy()
            self._joint_damping[:] = viscous + self._coulomb / np.maximum(np.abs(before), STICK_RADPS)
            mujoco.mj_fwdVelocity(model, data)
            mujoco.mj_step2(model, data)
            # MuJoCo's sensors see the acceleration before damping is taken implicitly; the arm moved with the one after.
            np.multiply(v - before, SUBSTEPS / DT, out=self._qacc)
            mujoco.mj_rnePostConstraint(model, data)
            mujoco.mj_sensorAcc(model, data)
            self._contacts = int(data.ncon)
            mujoco.mj_fwdPosition(model, data)
        mujoco.mj_comVel(model, data)
        self.q, self.v = self._qpos.copy(), v.copy()

    def gravity_torque(self) -> Array:
        """Joint torques that carry the arm's and the nominal tool's weight here [N m], shape (7,).

        The weight times how much the centre of mass of it all rises with each joint.
        """
        mujoco.mj_jacSubtreeCom(self._model, self._data, self._jacobian, self._base)
        torque = np.asarray(self._weight * self._jacobian[2])
        if self._forgotten:
            mujoco.mj_jacSubtreeCom(self._model, self._data, self._jacobian, self._tool)
            torque -= self._forgotten * self._jacobian[2]
        return torque

    def kinetic_energy(self) -> float:
        """[J]."""
        product = np.zeros(7)
        mujoco.mj_mulM(self._model, self._data, product, self.v)
        return float(self.v @ product / 2)

    def sensor_wrench(self) -> Wrench:
        """Wrench that what is below the F/T sensor exerts on it: force [N], then moment [N m].

        At the sensor's origin, in its axes, in the last half millisecond: contact, weight and inertia of the tool. MuJoCo's
        force and torque sensors read the wrench of the parent on the child.
        """
        fx, fy, fz, mx, my, mz = self._sensed.tolist()
        return -fx, -fy, -fz, -mx, -my, -mz

    def tool_motion(self) -> Array:
        """The indenter's motion in world: position p_WI [m], orientation x, y, z, w, velocities [m/s, rad/s], shape (13,).

        The linear velocity is that of the sphere's centre.
        """
        body, twist = self._indenter, self._twist
        mujoco.mj_objectVelocity(self._model, self._data, mujoco.mjtObj.mjOBJ_XBODY, body, twist, 0)
        quaternion = self._xquat[body]  # w first
        return np.concatenate((self._xpos[body], quaternion[1:], quaternion[:1], twist[3:], twist[:3]))

    def link_poses(self) -> Array:
        """Poses of the links `lbr.LINK_NAMES` in world: position [m], orientation x, y, z, w, shape (11, 7)."""
        quaternions = self._xquat[self._bodies]  # w first
        return np.column_stack((self._xpos[self._bodies], quaternions[:, 1:], quaternions[:, :1]))

    def contacts(self) -> int:
        """Number of contact points with table or base in the last step."""
        return self._contacts
