"""The controller's own model of the arm, on pinocchio: kinematics, inertia and Coriolis torques at one state."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

Array = NDArray[np.float64]

DOF = 7
SLOW_S = 0.1
"""Time scale on which motion is as much friction's as inertia's: postures and scans move this slowly or slower."""
_AXES = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED


class ArmModel:
    """Kinematics and dynamics of the arm, evaluated by `update(q, qd)` into its attributes.

    Attributes after `update` (valid until the next and as long as this object; most are views of pinocchio's own memory):
        R_WI: rotation of the indenter frame I in world, shape (3, 3), in Fortran order.
        p_WI: origin of I in world [m], shape (3,).
        J_W: Jacobian of V_WI_W (linear first, then angular, world axes, at I's origin), shape (6, 7).
        slow_mobility: the same with friction, (M + D SLOW_S)^-1: displacement over SLOW_S rather than acceleration, (7, 7).
        gravity: torques that hold the arm against gravity [N m], shape (7,).
        bias: Coriolis, centrifugal and gravity torques C(q, qd) qd + gravity [N m], shape (7,).
    """

    J_W: Array

    def __init__(self, urdf: str, frame: str = "indenter") -> None:
        """Builds the model from URDF text. Raises ValueError if it is no seven-joint arm with a link `frame`."""
        self._model = pin.buildModelFromXML(urdf)
        if self._model.nq != DOF or self._model.nv != DOF:
            raise ValueError(f"robot description has {self._model.nv} joints, the controller wants {DOF}")
        if not self._model.existFrame(frame):
            raise ValueError(f"robot description has no link {frame!r}")
        self._data = self._model.createData()
        self._slow_model = self._model.copy()
        self._slow_model.armature = self._slow_model.armature + SLOW_S * self._model.damping
        self._slow_data = self._slow_model.createData()
        self._frame = self._model.getFrameId(frame)
        self._q = np.zeros(DOF)
        self._mobility: Array = self._data.Minv
        self.gravity: Array = self._data.g
        self.bias: Array = self._data.nle
        self.slow_mobility: Array = self._slow_data.Minv
        placement = self._slow_data.oMf[self._frame]
        self.R_WI: Array = placement.rotation
        self.p_WI: Array = placement.translation
        self.position_lower: Array = self._model.lowerPositionLimit.copy()
        self.position_upper: Array = self._model.upperPositionLimit.copy()
        self.velocity_limit: Array = self._model.velocityLimit.copy()
        self.torque_limit: Array = self._model.effortLimit.copy()
        self.viscous_friction: Array = self._model.damping.copy()
        self.coulomb_friction: Array = self._model.upperDryFrictionLimit.copy()

    def update(self, q: Array, qd: Array) -> None:
        """Evaluates the model at joint positions `q` [rad] and velocities `qd` [rad/s], shapes (7,)."""
        self.update_gravity(q)
        slow, data, frame = self._slow_model, self._slow_data, self._frame
        pin.computeMinverse(slow, data, q)  # also places the joints and fills data.J
        pin.updateFramePlacement(slow, data, frame)
        self.J_W = pin.getFrameJacobian(slow, data, frame, _AXES)
        pin.nonLinearEffects(self._model, self._data, q, qd)

    def update_gravity(self, q: Array) -> None:
        """Evaluates `gravity` alone: what joint-space control needs besides its own calls."""
        self._q = q
        pin.computeGeneralizedGravity(self._model, self._data, q)

    @property
    def coriolis(self) -> Array:
        """Coriolis and centrifugal torques C(q, qd) qd [N m], shape (7,)."""
        return self.bias - self.gravity

    @property
    def mobility(self) -> Array:
        """Inverse of the joint-space inertia matrix [1/(kg m^2)], shape (7, 7), computed when it is asked for."""
        pin.computeMinverse(self._model, self._data, self._q)
        return self._mobility

    def inverse_dynamics(self, q: Array, qd: Array, qdd: Array) -> Array:
        """Torques without friction that give accelerations `qdd` [rad/s^2], gravity's among them, shape (7,)."""
        torque: Array = pin.rnea(self._model, self._data, q, qd, qdd)
        return torque

    def inertia(self, q: Array) -> Array:
        """The joint-space inertia matrix [kg m^2], shape (7, 7)."""
        inertia: Array = pin.crba(self._model, self._data, q)
        return inertia
