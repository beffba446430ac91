"""Two senses of the force at the tool, F/T sensor and joint torques, and how they compare; its position, speed and external force
from these measurements only; the perceived rest surface.

Both are tared in free air. The F/T sensor S reads in its axes

    w = G R_SW (F + m (g - a)) + b

with the contact force F, the weight and inertia of the tool of mass m, and a bias b. The joints' residual is

    r_i = (J^T F)_i + o_i + c_i v_i / (|v_i| + v_0)

with an offset o_i (zero of the sensor, masses of the links: it changes with the posture) and friction c_i, both learned in free
air by gradient descent. Weighted least squares gives the force that the joints feel,

    F = (J W J^T + 1 / F_max^2)^-1 J W (r - o - c v / (|v| + v_0)),    W = diag(1 / sd^2)

In a direction that no joint feels (a singular posture) the prior F_max decides: zero instead of amplified noise. After a reversal
sd also contains what is not yet known of the friction, which shrinks with the error of the gradient descent. The gain G is the
regression of the reading on the known weight and inertia while the tool moves freely.

The joints' residual is that of the momentum observer of De Luca and Haddadin,

    r = K_O (p - integral(tau + C^T qd - g + r) dt),    p = M(q) qd

with the measured joint torques tau, the Coriolis matrix C and the gravity torques g of the nominal arm (De Luca et al., IROS
2006, doi 10.1109/IROS.2006.282053; Haddadin et al., T-RO 2017, doi 10.1109/TRO.2017.2723903). It follows the external torques of
the joints with the time constant 1 / K_O.
"""

from math import exp, sqrt
from typing import Final, NamedTuple

import numpy as np
import pinocchio as pin

from palpate_models.numerics.compiled import compiled
from palpate_models.numerics.frames import GRAVITY, Array
from palpate_models.numerics.vectors import nearest_vertex
from palpate_models.robot.arm import urdf
from palpate_models.scenario.schema import CommandLevel, Robot

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


class SensesTuning(NamedTuple):
    """Limits of free air, and time constants of the tare there. A tuple, since a compiled function reads it."""

    fast_mps: float = 0.1
    """A tool that is faster does not touch anything: strokes are at 0.03 m/s."""
    free_ft_n: float = 1.0
    """Maximum tared force in free air by the F/T sensor."""
    free_joints_n: float = 2.0
    """Maximum tared force in free air by the joints."""
    offset_rad: float = 0.3
    """Travel of the joints, summed, over which their offsets are learned: gravity errors change with the posture."""
    tare_s: float = 1.0
    """Time over which F/T bias and joint offsets are learned at rest."""
    start_s: float = 0.1
    """Time over which they are learned before the arm first moves."""
    friction_gain: float = 0.03
    """Part of the joints' deviation that a sample adds to their friction."""
    friction_sd_nm: float = 0.3
    """SD of a joint's friction before the joint has moved in both directions, that of poor equipment."""
    slow_radps: float = 0.003
    """v_0: joint speed at which friction is half of its value."""
    torque_sd_nm: float = 0.3
    """Minimum SD of a joint's external torque."""
    torque_sd_share: float = 0.005
    """SD of a joint's external torque over its torque (friction) and over the change of that from its mean of the last `tare_s`
    in free air (errors of mass), with a torque sensor: after a fast motion the offset is still that of another posture."""
    damping_nms: float = 2.0
    """Error of the joints' damping [N m s/rad], twice that of typical equipment: in fast motion the joints feel less exactly."""
    force_max_n: float = 100.0
    """Prior of the force by the joints."""
    lag_s: float = 1 / GAIN_PER_S
    """Time constant of the observer; F/T reading and friction are made as late."""
    smooth_s: float = 0.05
    """Low-pass of the disagreement and of the joints' force."""
    load_s: float = 0.1
    """Low-pass of reading and load in the regression of the gain."""
    noise_s: float = 0.2
    """Averaging time of the noise."""
    still_mps: float = 0.005
    """Tool speed below which the tool is at rest."""


BY_SENSORS: Final = SensesTuning()
BY_CURRENT: Final = BY_SENSORS._replace(torque_sd_share=0.04)
"""Limits for an arm that takes positions: its torques are those of the drives' currents, with the friction of the gears."""
Arrays = tuple[Array, Array, Array]


class Measurement(NamedTuple):
    """Means of a status period."""

    q: Array
    """Joint positions [rad], shape (n,)."""
    qd: Array
    """Joint velocities [rad/s], shape (n,)."""
    wrench_S: Array
    """Reading of the F/T sensor, in its axes, force [N] then moment [N m], shape (6,)."""
    torque: Array
    """Measured joint torques, gravity included [N m], shape (n,)."""


class ForceComparison(NamedTuple):
    """Senses after a measurement, forces in N. All but gain and excitation are small if both senses are true."""

    joint_force: float
    """Magnitude of the tared force by the joints."""
    disagreement: float
    """Magnitude of the difference of the tared forces."""
    remainder: float
    """Maximum external torque of a joint that no force at the tool explains, in standard deviations."""
    offset_nm: float
    """Maximum offset of a joint."""
    drift: float
    """Change of the F/T bias since the arm first moved."""
    gain: float
    """Reading of the F/T sensor over the known weight and inertia of the tool."""
    excitation: float
    """Information in the gain: sum of the squared changes of the load [N^2]."""
    noise: float
    """Root mean square change of the F/T reading from one sample to the next, as far as it is white noise, at speeds at which the
    tool can touch: gear ripple makes a fast arm shake."""
    rest_noise: float
    """Noise at the latest rest in free air, where the arm's vibrations do not add to it."""
    joint_sd: float = 0.0
    """Standard deviation of the force by the joints in the direction that they feel least."""


class ForceSenses:
    """Compares the senses at every measurement."""

    def __init__(self, joints: int, tuning: SensesTuning = BY_SENSORS) -> None:
        self._tuning = tuning
        self._joints = np.zeros((6, joints))
        """Rows: offset, friction, the late sign of the speed, its mean, the mean load in free air, and the SD of the friction."""
        self._joints[5] = tuning.friction_sd_nm
        self._tool = np.zeros((11, 3))
        """Rows of `_compare`."""
        self._sums = np.zeros(5)
        self._started = False

    def compare(
        self, measured: Measurement, residual: Array, J_W: Array, load_S: Array, R_WS: Array, speed: float, dt_s: float,
        free: tuple[bool, bool],
    ) -> ForceComparison:  # fmt: skip
        """Return the comparison.

        Args:
            measured: by the robot.
            residual: external joint torques [N m], shape (n,).
            J_W: Jacobian of the indenter's centre, shape (3, n).
            load_S: weight and inertia of the tool in sensor axes [N], shape (3,).
            R_WS: orientation of the sensor, shape (3, 3).
            speed: of the indenter's centre [m/s].
            dt_s: time since the last measurement [s].
            free: the arm has not moved and nothing touches it; there is no patient where it is.
        """
        reading_S = measured.wrench_S[:3]
        if not self._started:
            self._started = True
            unloaded_S = reading_S - load_S
            self._joints[0], self._joints[4] = residual, measured.torque
            self._tool[:3], self._tool[5:10] = unloaded_S, (reading_S, load_S, reading_S, load_S, reading_S)
        state, motion = (self._joints, self._tool, self._sums), (measured.qd, residual, J_W, measured.torque)
        return ForceComparison(*_compare(state, motion, (reading_S, load_S, R_WS), speed, dt_s, free, self._tuning))


@compiled
def _share(dt_s: float, time_s: float) -> float:
    """Return the weight of a new sample in a running mean over `time_s`."""
    return dt_s / (time_s + dt_s)


@compiled
def _norm(x: Array) -> float:
    return float(np.sqrt((x * x).sum()))


@compiled
def _compare(
    state: Arrays,
    motion: tuple[Array, Array, Array, Array],
    ft: Arrays,
    speed: float,
    dt_s: float,
    free: tuple[bool, bool],
    tuning: SensesTuning,
) -> tuple[float, float, float, float, float, float, float, float, float, float]:
    """Return the fields of `ForceComparison`, and update `state`: the rows of `joints` and `tool`, and `sums`.

    `tool`: F/T bias, first bias and late F/T force (S), difference and force by the joints (W), smooth reading, smooth load and
    their means in free air, last reading (S). `sums`: reading times load, load squared, squared change of the reading, and the
    same at rest [N^2]; smooth speed of the fastest joint [rad/s].
    """
    (joints, tool, sums), (qd, residual, J_W, load), (reading_S, load_S, R_WS) = state, motion, ft
    offset, friction, sign, mean_sign, usual, friction_sd = joints[0], joints[1], joints[2], joints[3], joints[4], joints[5]
    bias_S, first_S, late_S, difference_W, joints_W = tool[0], tool[1], tool[2], tool[3], tool[4]
    lag, smooth = _share(dt_s, tuning.lag_s), _share(dt_s, tuning.smooth_s)
    late_S += lag * (reading_S - load_S - late_S)
    sign += lag * (qd / (np.abs(qd) + tuning.slow_radps) - sign)
    ft_S = late_S - bias_S

    deviation = residual - offset - friction * sign
    loaded = np.maximum(np.abs(load), np.abs(load - usual))
    sd = np.hypot(np.maximum(tuning.torque_sd_nm, tuning.torque_sd_share * loaded), friction_sd * (sign - mean_sign))
    J, torque = J_W / sd, deviation / sd
    information = J @ J.T + np.eye(3) / tuning.force_max_n**2
    force_W = np.linalg.solve(information, J @ torque)
    remainder = np.abs(torque - force_W @ J).max()

    (starting, clear), still, change_S = free, speed < tuning.still_mps, reading_S - tool[9]
    at_rest = (clear and still) or (_norm(ft_S) < tuning.free_ft_n and _norm(force_W) < tuning.free_joints_n)
    if starting or at_rest or speed > tuning.fast_mps:
        slow = _share(dt_s, tuning.start_s if starting else tuning.tare_s)
        bias_S += slow * ft_S
        travel = np.abs(qd).sum() * dt_s / tuning.offset_rad
        settled = 1 - (1 - slow) * exp(-travel)
        offset += settled * deviation
        usual += slow * (load - usual)
        mean_sign += settled * (sign - mean_sign)
        friction += tuning.friction_gain * (sign - mean_sign) * deviation
        friction_sd *= 1 - tuning.friction_gain * (sign - mean_sign) ** 2
        tool[5] += _share(dt_s, tuning.load_s) * (reading_S - tool[5])
        tool[6] += _share(dt_s, tuning.load_s) * (load_S - tool[6])
        tool[7] += slow * (tool[5] - tool[7])
        tool[8] += slow * (tool[6] - tool[8])
        change = tool[6] - tool[8]
        sums[0] += (change * (tool[5] - tool[7])).sum()
        sums[1] += (change * change).sum()
    white = -2 * (change_S * tool[10]).sum()  # the next change of white noise is half the other way; a step of the force has none
    if speed < tuning.fast_mps:
        sums[2] += _share(dt_s, tuning.noise_s) * (white - sums[2])
    if at_rest and still:
        sums[3] += _share(dt_s, tuning.noise_s) * (white - sums[3])
    tool[9], tool[10] = reading_S, change_S
    if starting:
        first_S[:] = bias_S
    difference_W += smooth * (R_WS @ ft_S - force_W - difference_W)
    joints_W += smooth * (force_W - joints_W)
    gain = sums[0] / sums[1] if sums[1] > 0.0 else 1.0
    drift = _norm(bias_S - first_S)
    noise, rest_noise = np.sqrt(max(sums[2], 0.0)), np.sqrt(max(sums[3], 0.0))
    sums[4] += smooth * (np.abs(qd).max() - sums[4])
    joint_sd = np.hypot(1.0, tuning.damping_nms * sums[4] / tuning.torque_sd_nm) / np.sqrt(np.linalg.eigvalsh(information)[0])
    forces = _norm(joints_W), _norm(difference_W), remainder, np.abs(offset).max(), drift
    return *forces, gain, sums[1], noise, rest_noise, joint_sd


class BiasTuning(NamedTuple):
    """Limits within which a reading counts as sensor bias."""

    longest_s: float = 1.0
    """Longest time of rest whose mean is the bias: a sensor that drifts while the arm waits must not be taken for true."""
    largest_n: float = 6.0
    """A larger force before the first motion is contact, not bias: poor sensors have up to 5.2 N of bias."""


BIAS = BiasTuning()
OVER_M = 0.015
"""A tool is over the perceived surface up to this distance along it from the nearest vertex; the mesh has 5 mm."""


class Tool(NamedTuple):
    """Measured state of the indenter."""

    p_W: Array
    """Centre of the sphere [m], shape (3,)."""
    speed: float
    """Speed of the centre [m/s]."""
    force: float
    """Magnitude of the external force [N]: the larger of both senses. By the F/T sensor: minus tool weight and first bias."""
    joint_force: float = 0.0
    """Magnitude of the external force by the joints alone [N]."""
    contact_force: float = 0.0
    """As `force`, but by the F/T sensor also minus the inertia of the tool: a tool that a fast arm shakes touches nothing."""


class ToolSense:
    """Evaluates tool state from joint state and F/T reading. The sensor bias is the mean of the first second of rest."""

    def __init__(self, robot: Robot) -> None:
        self._model = pin.buildModelFromXML(urdf(robot, geometry=False))
        self._data = self._model.createData()
        self._observer = MomentumObserver(self._model, "indenter")
        self._senses = ForceSenses(self._model.nv, BY_CURRENT if robot.level is CommandLevel.POSITION else BY_SENSORS)
        self._mass = robot.tool_mass_kg
        self._velocity_W: Array | None = None
        self.comparison: ForceComparison
        """Comparison of both senses after the latest measurement."""
        self._indenter = self._model.getFrameId("indenter")
        self._sensor = self._model.getFrameId("ft_sensor")
        self._p_WI: Array = self._data.oMf[self._indenter].translation
        self._R_SW: Array = self._data.oMf[self._sensor].rotation.T
        """Views of pinocchio's latest result."""
        self._weight_W = np.array((0.0, 0.0, -robot.tool_mass_kg * GRAVITY))
        self._bias_S, self._rested, self._rested_s, self._moved = np.zeros(3), 0, 0.0, False

    def sense(self, measured: Measurement, dt_s: float, clear: bool = False) -> Tool:
        """Return the tool state of a measurement that comes `dt_s` [s] after the one before; `clear`: there is no patient."""
        model, data = self._model, self._data
        q, qd, wrench_S, torque = measured
        pin.forwardKinematics(model, data, q)
        pin.updateFramePlacement(model, data, self._indenter)
        pin.updateFramePlacement(model, data, self._sensor)
        force_S = wrench_S[:3] - self._R_SW @ self._weight_W
        observed = self._observer
        if len(torque):
            observed.update(q, qd, torque, dt_s)
        else:
            observed.place(q)
        velocity_W = observed.J_W @ qd
        before_W = velocity_W if self._velocity_W is None else self._velocity_W
        self._velocity_W = velocity_W
        acceleration_W = (velocity_W - before_W) / dt_s if dt_s > 0.0 else np.zeros(3)
        inertia_S = -self._mass * (self._R_SW @ acceleration_W)
        residual = observed.residual
        if not len(torque):  # such an arm has one sense: the F/T sensor takes the place of the other, and both agree
            measured = measured._replace(torque=np.zeros(model.nv))
            residual = observed.J_W.T @ self._R_SW.T @ (force_S - inertia_S)
        speed = _length(velocity_W)
        over = self._rested_s > BIAS.longest_s
        self._moved = self._moved or over or speed > BY_SENSORS.still_mps or _length(force_S) > BIAS.largest_n
        if not self._moved:
            self._rested, self._rested_s = self._rested + 1, self._rested_s + dt_s
            self._bias_S = self._bias_S + (force_S - self._bias_S) / self._rested
        load_S, free = self._R_SW @ self._weight_W + inertia_S, (not self._moved, clear)
        self.comparison = self._senses.compare(measured, residual, observed.J_W, load_S, self._R_SW.T, speed, dt_s, free)
        ft_S, joints = force_S - self._bias_S, self.comparison.joint_force
        force, contact_force = (max(_length(felt_S), joints) for felt_S in (ft_S, ft_S - inertia_S))
        return Tool(self._p_WI.copy(), speed, force, joints, contact_force)


def _length(x: Array) -> float:
    return sqrt(float(x @ x))


class RestSurface:
    """Depth below the perceived rest surface: the sphere against the tangent plane of the nearest vertex.

    Deliberately independent of planning's splines: on a 5 mm mesh of 0.25 m radius the plane is off by less than 0.05 mm.
    """

    def __init__(self, vertices_W: Array, normals_W: Array, radius: float) -> None:
        """Take vertices [m] and outward unit normals, shapes (n, 3), and the sphere's `radius` [m].

        Raises ValueError for an empty mesh or different shapes.
        """
        if vertices_W.shape != normals_W.shape or not len(vertices_W):
            raise ValueError(f"perceived surface: {vertices_W.shape} vertices, {normals_W.shape} normals: expected one shape")
        self._vertices, self._normals, self._radius = np.ascontiguousarray(vertices_W, float), normals_W, radius

    def depth(self, p_W: Array) -> tuple[float, bool]:
        """Return the depth of the sphere's deepest point [m], negative above the surface, and True if it is over the surface."""
        _, i = nearest_vertex(p_W, self._vertices)
        gap = p_W - self._vertices[i]
        distance = float(self._normals[i] @ gap)
        return self._radius - distance, float(gap @ gap) - distance**2 < OVER_M**2
