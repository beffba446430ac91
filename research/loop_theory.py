"""Theory of the delayed contact: the arm's seven joints, linear and sampled, and their stability by Nyquist's criterion.

    M v' = -D v - K q_c - B v_c - J' Z_t J q_t      q_c, q_t: what controller and tissue know, late by the delays

Robot: semi-implicit steps as DART takes them, with its viscous friction D. Controller: K and B differentiated from its own
torques. Tissue: along the normal Z_t comes from the response of its force to a small step of depth, whatever the wall is made
of; across it the skin sticks and shears. All at 1 ms:

    G(z) = dt^2 z / (z - 1) ((M + dt D) z - M)^-1,   H_c(z) = K + B (1 - 1/z) / dt,   Z_t(z) = (1 - 1/z) sum_k r_k z^-k
    d(z) = det(1 + G (H_c z^-2c + J' Z_t J z^-2t))       two messages a loop, each late by c or t milliseconds

d is analytic outside the unit circle and 1 at infinity, so minus its winding number along the circle counts its zeros outside.
Left out: dry friction, which damps small motion, so a quiet contact can outlive the margin until something nudges it; the
limit on the torque's rate; and contact that is lost.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from palpate_bus.contract import contract
from palpate_bus.setpoint import ControlMode, Setpoint
from palpate_control.impedance import ADMITTANCE, ImpedanceController
from palpate_control.model import ArmModel
from palpate_control.reference import Extrapolator, Reference
from palpate_models.numerics.frames import Array
from palpate_models.patient.phantom import build_phantom
from palpate_models.robot.arm import urdf
from palpate_planning.setpoints import CARTESIAN_STIFFNESS, DAMPING_RATIO, NORMAL_STIFFNESS, POSTURE_STIFFNESS
from palpate_tissue.backends.winkler.tissue import WinklerTissue
from palpate_tissue.contact import shear_stiffness
from palpate_validation.probing import STILL
from research.contact_rig import CONTACT_PATH, CONTROL_PATH, DEPTH_M, scenario, start_posture

Complex = NDArray[np.complex128]

DT = 1e-3
STEP_M = 2e-5
MOST_MS = 24


@dataclass(frozen=True)
class LinearLoop:
    """The linear model of one contact. Joint matrices have shape (7, 7)."""

    inertia: Array
    """M [kg m^2]"""
    friction: Array
    """D [N m s/rad]"""
    stiffness: Array
    """K of the controller [N m/rad]."""
    damping: Array
    """B of the controller [N m s/rad]."""
    J: Array
    """Jacobian of the contact point, x, y and z of world, shape (3, 7)."""
    shear: float
    """Shear stiffness of the sticking skin [N/m]."""
    response: Array
    """Force over a step of depth [N/m], a value a millisecond, shape (n,)."""

    @cached_property
    def _contour(self) -> tuple[Complex, Complex, Complex]:
        """The contour z, (n,), and G H_c and G J' Z_t J on it, (n, 7, 7).

        It is finest where the arm's double pole is near. What grows by less than 1e-5 a millisecond counts as stable.
        """
        half = np.concatenate((np.geomspace(1e-5, 0.05, 200), np.linspace(0.05, np.pi, 1500)[1:]))
        z = (1 + 1e-5) * np.exp(1j * np.concatenate((-half[::-1], half)))
        at = z[:, None, None]
        robot = DT**2 * at / (at - 1) * np.linalg.inv((self.inertia + DT * self.friction) * at - self.inertia)
        control = self.stiffness + self.damping * (1 - 1 / at) / DT
        normal = (1 - 1 / z) * np.polyval(self.response[::-1], 1 / z) + self.response[-1] * z ** -float(len(self.response))
        along, across = np.outer(self.J[2], self.J[2]), self.J[:2].T @ self.J[:2]
        return z, robot @ control, robot @ (along * normal[:, None, None] + across * self.shear)

    def stable(self, control_ms: int, contact_ms: int) -> bool:
        """Return True if stable with these delays [ms] of each message of the control and of the contact path."""
        z, control, tissue = self._contour
        late = z[:, None, None]
        d = np.linalg.det(np.eye(7) + control * late ** (-2 * control_ms) + tissue * late ** (-2 * contact_ms))
        turns = np.angle(np.roll(d, -1) / d).sum() / (2 * np.pi)
        return round(-float(turns)) <= 0

    def margin_ms(self, topics: tuple[str, ...]) -> int:
        """Largest delay [ms] of each message of `topics` with which it is stable, up to 24; -1 if without any it is not."""
        control, contact = int(CONTROL_PATH[0] in topics), int(CONTACT_PATH[0] in topics)
        for d in range(MOST_MS + 1):
            if not self.stable(d * control, d * contact):
                return d - 1
        return MOST_MS


def linearise(contrast: float, stiffness: float, across: float = 1.0) -> LinearLoop:
    """The loop about a contact 10 mm deep on a wall `contrast` times the default's, `stiffness` [N/m] asked for along the tool.

    `across` multiplies what an examination asks for across the tool.
    """
    q = start_posture(contrast)
    model = ArmModel(urdf(scenario(contrast).robot))
    model.update(q, np.zeros(7))
    asked = CARTESIAN_STIFFNESS.copy()
    asked[:2] *= across
    asked[2] = stiffness
    setpoint = Setpoint(
        mode=ControlMode.CARTESIAN, stamp=0, R_WD=model.R_WI.copy(), p_WD=model.p_WI.copy(), V_WD=np.zeros(6), F_W=np.zeros(6),
        stiffness=asked, damping_ratio=DAMPING_RATIO, q=q, qd=np.zeros(7), joint_stiffness=np.full(7, POSTURE_STIFFNESS),
    )  # fmt: skip
    extrapolator = Extrapolator(contract().topics["planning/setpoint"].period)
    extrapolator.accept(setpoint, 0)
    reference = extrapolator.at(0)
    zero, eye = np.zeros(7), np.eye(7)
    springs = [-_torque(model, reference, q + 1e-6 * e, zero) / 1e-6 for e in eye]
    damping = [-_torque(model, reference, q, 1e-5 * e) / 1e-5 for e in eye]
    radius = scenario(contrast).robot.indenter_radius_m
    model.update(q, zero)
    lever = np.array(((0, -radius, 0), (radius, 0, 0), (0, 0, 0)))  # velocity of the point below the centre by rotation
    return LinearLoop(
        inertia=model.inertia(q),
        friction=np.diag(model.viscous_friction),
        stiffness=np.array(springs).T,
        damping=np.array(damping).T,
        J=model.J_W[:3] + lever @ model.J_W[3:],
        shear=shear_stiffness(scenario(contrast).phantom.stiffness.k_w_n_per_m3),
        response=tissue_response(contrast),
    )


def admittance_gain(contrast: float, yield_s: float = ADMITTANCE.yield_s) -> float:
    """Return the largest |L| of `palpate_control.impedance` on a wall `contrast` times the default's, for an ideal arm.

    Below 1 the contact is stable with any delay.
    """
    z = np.exp(1j * np.geomspace(1e-5, np.pi, 2000))
    response = tissue_response(contrast)
    wall = (1 - 1 / z) * np.polyval(response[::-1], 1 / z) + response[-1] * z ** -float(len(response))
    decay = np.exp(-DT / yield_s)
    return float(np.abs(wall * (1 - decay) / (z - decay) / NORMAL_STIFFNESS).max())


def _torque(model: ArmModel, reference: Reference, q: Array, qd: Array) -> Array:
    """The controller's torques, Coriolis torques taken off [N m], shape (7,); from a fresh one, as it limits their rate."""
    torque = ImpedanceController(model).command(q, qd, reference)
    return np.asarray(torque - (model.bias - model.gravity))


def tissue_response(contrast: float) -> Array:
    """Force [N] per metre of a small sudden step of depth at 10 mm, each millisecond after it, shape (n,)."""
    chosen = scenario(contrast)
    radius = chosen.robot.indenter_radius_m
    forces = []
    for step in (0.0, STEP_M):
        tissue = WinklerTissue(build_phantom(chosen.phantom, chosen.seed), chosen.phantom.stiffness)
        p = np.array((0.0, 0.0, radius - DEPTH_M))
        for _ in range(400):
            tissue.step(0.0, p, STILL, radius)
        p[2] -= step
        forces.append([tissue.step(0.0, p, STILL, radius)[0][2] for _ in range(400)])
    return np.asarray((np.array(forces[1]) - np.array(forces[0])) / STEP_M)
