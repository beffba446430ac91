"""External joint torques from what an arm's joints report: the momentum observer of De Luca and Haddadin.

    r = K_O (p - integral(tau + C^T qd - g + r) dt),    p = M(q) qd

with the measured joint torques tau, the Coriolis matrix C and the gravity torques g of the nominal arm (De Luca et al., IROS
2006, doi 10.1109/IROS.2006.282053; Haddadin et al., T-RO 2017, doi 10.1109/TRO.2017.2723903). r follows the external torques
of the joints with the time constant 1 / K_O. A force F at a point with the Jacobian J causes r = J^T F.
"""

from typing import Final

import numpy as np
import pinocchio as pin

from palpate_models.numerics.frames import Array

_WORLD_AXES: Final = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED


GAIN_PER_S: Final = 30.0
"""K_O. It filters the gears' ripple."""
GAP_S: Final = 0.05
"""Time without measurements after which the momentum cannot be balanced."""


class MomentumObserver:
    """External torques of any arm that pinocchio models, with n joints.

    An arm without torque sensors could give its motor currents times the torque constants, less its friction model.
    """

    def __init__(self, model: pin.Model, frame: str) -> None:
        self._model, self._data, self._frame = model, model.createData(), model.getFrameId(frame)
        self.residual: Array = np.zeros(model.nv)
        """r, the external joint torques [N m], shape (n,)."""
        self.J_W: Array = np.zeros((3, model.nv))
        """Jacobian of the frame's origin in world axes, shape (3, n)."""
        self._integral: Array | None = None
        self._torque = self.residual

    def update(self, q: Array, qd: Array, torque: Array, dt_s: float) -> None:
        """Advance by `dt_s` [s], in which `q` [rad], `qd` [rad/s] and `torque` [N m], shapes (n,), were measured on average."""
        model, data = self._model, self._data
        momentum = pin.crba(model, data, q) @ qd
        gravity = pin.computeGeneralizedGravity(model, data, q)
        coriolis = pin.computeCoriolisMatrix(model, data, q, qd)
        if self._integral is None or dt_s > GAP_S:  # continues with the last residual
            self._integral, self._torque = momentum - self.residual / GAIN_PER_S, torque
            dt_s = 0.0
        # Momentum is that of the middle of the time; the torque between two middles is the mean of both.
        self._integral = self._integral + dt_s * ((torque + self._torque) / 2 + qd @ coriolis - gravity + self.residual)
        self._torque = torque
        self.residual = GAIN_PER_S * (momentum - self._integral)
        self.place(q)

    def place(self, q: Array) -> None:
        """Set the Jacobian alone, for an arm without torque sensors."""
        self.J_W = pin.computeFrameJacobian(self._model, self._data, q, self._frame, _WORLD_AXES)[:3]
