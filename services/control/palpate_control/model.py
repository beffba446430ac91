"""Arm model of the controller, on pinocchio: kinematics, inertia and Coriolis torques at one state."""

import pinocchio as pin

from palpate_models.numerics.frames import Array

_AXES = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED


class ArmModel:
    """Kinematics and dynamics of the arm, evaluated by `update(q, qd)` into its attributes.

    Attributes after `update` (most are views of pinocchio's memory, valid until the next evaluation):
        R_WI: rotation of the indenter frame I in world, shape (3, 3), in Fortran order.
        p_WI: origin of I in world [m], shape (3,).
        J_W: Jacobian of V_WI_W (linear first, then angular, world axes, at I's origin), shape (6, n).
        gravity: torques that hold the arm against gravity [N m], shape (n,).
        bias: Coriolis, centrifugal and gravity torques C(q, qd) qd + gravity [N m], shape (n,).
    """

    J_W: Array

    def __init__(self, urdf: str, frame: str = "indenter") -> None:
        """Build the model from URDF text. Raises ValueError unless it is an arm of revolute joints with a link `frame`."""
        self._model = pin.buildModelFromXML(urdf)
        self.joints: int = self._model.nv
        if self._model.nq != self.joints:
            raise ValueError(f"robot description has {self._model.nq} positions of {self.joints} joints, expected one a joint")
        if not self._model.existFrame(frame):
            raise ValueError(f"robot description has no link {frame!r}")
        self._data = self._model.createData()
        self._frame = self._model.getFrameId(frame)
        placement = self._data.oMf[self._frame]
        self.R_WI: Array = placement.rotation
        self.p_WI: Array = placement.translation
        self.gravity: Array = self._data.g
        self.bias: Array = self._data.nle
        self.position_lower: Array = self._model.lowerPositionLimit.copy()
        self.position_upper: Array = self._model.upperPositionLimit.copy()
        self.velocity_limit: Array = self._model.velocityLimit.copy()
        self.torque_limit: Array = self._model.effortLimit.copy()
        self.viscous_friction: Array = self._model.damping.copy()
        self.coulomb_friction: Array = self._model.upperDryFrictionLimit.copy()

    def update(self, q: Array, qd: Array) -> None:
        """Evaluate the model at joint positions `q` [rad] and velocities `qd` [rad/s], shapes (n,)."""
        self.update_kinematics(q)
        pin.nonLinearEffects(self._model, self._data, q, qd)
        self.update_gravity(q)

    def update_kinematics(self, q: Array) -> None:
        """Evaluate `R_WI`, `p_WI` and `J_W` only."""
        self.J_W = pin.computeFrameJacobian(self._model, self._data, q, self._frame, _AXES)

    def update_gravity(self, q: Array) -> None:
        """Evaluate `gravity` only, for joint-space control."""
        pin.computeGeneralizedGravity(self._model, self._data, q)

    def inverse_dynamics(self, q: Array, qd: Array, qdd: Array) -> Array:
        """Return the torques for accelerations `qdd` [rad/s^2], with gravity and without friction [N m], shape (n,)."""
        torque: Array = pin.rnea(self._model, self._data, q, qd, qdd)
        return torque

    def inertia(self, q: Array) -> Array:
        """Return the joint-space inertia matrix [kg m^2], shape (n, n)."""
        M: Array = pin.crba(self._model, self._data, q)
        return M
