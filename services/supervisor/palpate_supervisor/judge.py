"""Judges measurements: limits of the scenario, and which sensor is dead, wrong or late. Numbers in, breaches out."""

from collections import deque
from math import exp, hypot, sqrt
from typing import Any, Final, NamedTuple

import numpy as np

from palpate_bus.messages.codes import HoldCause, StopCause, StopLevel
from palpate_models.numerics.frames import Array
from palpate_models.scenario.schema import Limits
from palpate_supervisor.senses import ForceComparison, Measurement, Tool


class SupervisorTuning(NamedTuple):
    """Margins and delays of the limit checks."""

    lookahead_s: float = 0.1
    """Force is extrapolated this far: a retreat takes 30-50 ms to start, and a fallback hold as long again."""
    fast_nps: float = 30.0
    """Force is extrapolated only if it rises faster than this; planning handles slower forces."""
    rate_samples: int = 3
    """Measurements over which the force rate is taken."""
    force_patience_ns: int = 50_000_000
    """Planning retreats by itself at the soft limit; the supervisor stops if the force stays above it for this long."""
    soft_stop_timeout_ns: int = 200_000_000
    """An uncleared soft stop escalates to an emergency stop after this time."""
    rising_timeout_ns: int = 40_000_000
    """Same, while force is rising fast."""
    speed_margin: float = 1.3
    """Free motion is planned up to `speed_mps`; the arm overshoots it by a few percent."""
    depth_margin_m: float = 0.025
    """Tolerated error of the perceived surface, from which depth is measured here. Its SD is about 7 mm for camera and arm
    together (5.6 mm for the camera alone, 12 tuning patients; touches were up to 13 mm inward, 6 examinations). The margin is
    three SD plus the tracking error. Planning measures depth from the touched skin; this check is independent of it."""
    contact_n: float = 5.0
    """Force that is certainly contact: tool inertia causes 1.4 N at 4 m/s^2, and a sensor that warms up drifts by 2 N."""


LIMITS = SupervisorTuning()


class Breach(NamedTuple):
    """A limit that is violated now. `cause` is the code to act on; `reason` is text for people."""

    level: StopLevel
    cause: StopCause
    reason: str
    timeout_ns: int = LIMITS.soft_stop_timeout_ns
    """Time that a soft stop has to end the breach."""
    beyond: float = 0.0
    """Amount beyond the limit of depth or workspace [m], or of the soft stop's force [N]."""
    culprit: str = ""
    """Role or topic that is missing or invalid."""
    hold: int = HoldCause.NONE
    """Cause of the driver's hold."""


class LimitWatch:
    """Checks the tool at every measurement."""

    def __init__(self, limits: Limits, X_AW: Array) -> None:
        """`X_AW`: pose of the world in the abdomen frame, in which the workspace is given, shape (4, 4)."""
        self._limits = limits
        self._R_AW, self._p_AW = X_AW[:3, :3], X_AW[:3, 3]
        self._forces: deque[tuple[int, float]] = deque(maxlen=LIMITS.rate_samples + 1)
        self._over_since: int | None = None

    def judge(self, tool: Tool, depth: float | None, stamp: int, t: int) -> list[Breach]:
        """Return the breaches at `t` [ns] of a measurement stamped `stamp` [ns].

        `depth` [m] is below the perceived surface. It is None without a surface and where the tool is not over it: there,
        workspace and force are the limits.
        """
        p_W, speed, force = tool.p_W, tool.speed, tool.force
        found = self._speed(speed, tool.contact_force) + self._force(force, stamp, t) + self._workspace(p_W)
        return found if depth is None else found + self._depth(depth)

    def _force(self, force: float, stamp: int, t: int) -> list[Breach]:
        limits, forces = self._limits, self._forces
        if forces and stamp <= forces[-1][0]:  # repeated measurement, or a clock that was set back: no rate
            forces.clear()
        forces.append((stamp, force))
        begin, before = forces[0]
        rate = (force - before) / ((stamp - begin) / 1e9) if len(forces) > LIMITS.rate_samples else 0.0
        soon = force + (rate * LIMITS.lookahead_s if rate > LIMITS.fast_nps else 0.0)
        if force <= limits.force_soft_stop_n:
            self._over_since = None
        elif self._over_since is None:
            self._over_since = t
        rising = soon > limits.force_soft_stop_n and rate > LIMITS.fast_nps
        lasting = self._over_since is not None and t - self._over_since >= LIMITS.force_patience_ns
        if not (rising or lasting) and soon <= limits.force_emergency_n:
            return []
        found = f"external force {force:.1f} N, rising at {rate:.0f} N/s" if rate > 0 else f"external force {force:.1f} N"
        level, limit = StopLevel.SOFT_STOP, f"soft-stop limit {limits.force_soft_stop_n:g} N"
        if not soon <= limits.force_emergency_n:
            level, limit = StopLevel.EMERGENCY, f"emergency limit {limits.force_emergency_n:g} N"
        timeout = LIMITS.rising_timeout_ns if rising else LIMITS.soft_stop_timeout_ns
        return [Breach(level, StopCause.FORCE, f"{found}, {limit}", timeout, soon - limits.force_soft_stop_n)]

    def _depth(self, depth: float) -> list[Breach]:
        limit = self._limits.depth_m + LIMITS.depth_margin_m
        if depth <= limit:
            return []
        level = StopLevel.EMERGENCY if depth > limit + LIMITS.depth_margin_m else StopLevel.SOFT_STOP
        reason = f"depth {depth * 1e3:.1f} mm below the perceived surface, limit {limit * 1e3:.1f} mm"
        return [Breach(level, StopCause.DEPTH, reason, beyond=depth - limit)]

    def _speed(self, speed: float, force: float) -> list[Breach]:
        free = self._limits.speed_mps * LIMITS.speed_margin
        if not speed <= free:  # also for NaN
            reason = f"robot/status: tool speed {speed:.2f} m/s, limit {free:.2f} m/s"
            return [Breach(StopLevel.EMERGENCY, StopCause.SPEED, reason, culprit="robot/status")]
        contact = self._limits.contact_speed_mps
        if force > LIMITS.contact_n and speed > contact:
            reason = f"robot/status: tool speed {speed:.2f} m/s at {force:.1f} N, limit in contact {contact:.2f} m/s"
            return [Breach(StopLevel.EMERGENCY, StopCause.SPEED, reason, culprit="robot/status")]
        return []

    def _workspace(self, p_W: Array) -> list[Breach]:
        p_A, low, high = self._R_AW @ p_W + self._p_AW, self._limits.workspace_min_m, self._limits.workspace_max_m
        beyond = np.maximum(low - p_A, p_A - high)
        k = int(np.argmax(beyond))  # also for NaN
        if beyond[k] <= 0.0:
            return []
        reason = f"tool at {'xyz'[k]} = {p_A[k]:.3f} m in the abdomen frame, allowed {low[k]:g} to {high[k]:g} m"
        return [Breach(StopLevel.EMERGENCY, StopCause.WORKSPACE, reason, beyond=float(beyond[k]))]


FT, JOINTS, STATUS, EXAM = "ft/wrench", "joint_states", "robot/status", "exam/state"


class JudgeTuning(NamedTuple):
    """Limits of the comparison. `research/senses.py` has the largest values of undisturbed examinations."""

    disagreement_sd: float = 3.5
    """Limit of the disagreement, in SDs of the joints' force in its least certain direction (LBR at the abdomen: 1.0 N)."""
    disagreement_n: tuple[float, float] = (3.0, 6.0)
    """Bounds of that limit."""
    disagreements: int = 5
    """Measurements in a row beyond it: wrong joints turn the weight of the tool at once, and are recognised in this time."""
    remainder_sd: float = 10.0
    """External torque that no force at the tool explains."""
    blamed_sd: float = 3.5
    """Above it a disagreement is blamed on the joints, below it on the F/T sensor."""
    offset_nm: float = 6.0
    drift_n: float = 4.0
    gain_sds: float = 4.0
    """Limit of the gain's error in standard deviations."""
    gain_sd: float = 0.08
    """Standard deviation of the gain of poor sensors, weighed by a tool whose mass is not known exactly."""
    wander_n: float = 0.33
    """Wandering of the bias while the load changes; its error of the gain falls with the root of the information."""
    excitation_n2: float = 5.0
    """Minimum information on the gain for the self-test."""
    noise_n: float = 1.5
    rest_noise_n: float = 0.4
    """Twice that of the noisiest published sensor of this class."""
    tested_above_m: float = 0.015
    """The self-test must be complete before the tool is this low above the perceived surface."""
    never_ns: int = 2**62
    """A soft stop of a wrong F/T sensor does not escalate: the retreat does not use it, and the joints still limit the force."""


SENSES = JudgeTuning()


class SensorJudge:
    """Finds the sensor that is wrong."""

    def __init__(self) -> None:
        self._tested = False
        self._disagreed, self._limit = 0, 0.0

    def judge(self, comparison: ForceComparison, depth: float | None) -> list[Breach]:
        """Return the breaches; `depth` [m] is that of the tool below the perceived surface, None while there is none."""
        c = comparison
        low, high = SENSES.disagreement_n
        self._limit = min(max(SENSES.disagreement_sd * c.joint_sd, low), high)
        self._disagreed = self._disagreed + 1 if c.disagreement > self._limit else 0
        limit_sd = SENSES.remainder_sd if self._disagreed < SENSES.disagreements else SENSES.blamed_sd
        if c.remainder > limit_sd:
            return _joints(f"torques that no force at the tool explains, {c.remainder:.1f} standard deviations")
        if c.offset_nm > SENSES.offset_nm:
            return _joints(f"torque {c.offset_nm:.1f} N m off in free air, limit {SENSES.offset_nm:g} N m")
        return self._judge_ft(c, depth)

    def _judge_ft(self, c: ForceComparison, depth: float | None) -> list[Breach]:
        if self._disagreed >= SENSES.disagreements:
            return _ft(f"{c.disagreement:.1f} N from the force by the joints, limit {self._limit:.1f} N")
        for noise, limit, where in ((c.noise, SENSES.noise_n, ""), (c.rest_noise, SENSES.rest_noise_n, " at rest")):
            if noise > limit:
                return _ft(f"noise of {noise:.1f} N{where}, limit {limit:g} N")
        if c.drift > SENSES.drift_n:
            return _ft(f"bias changed by {c.drift:.1f} N in free air, limit {SENSES.drift_n:g} N")
        return self._test(c, depth)

    def _test(self, c: ForceComparison, depth: float | None) -> list[Breach]:
        """Weigh the tool: it is known, and its weight and inertia change in sensor axes on the way to the first target."""
        if c.excitation >= SENSES.excitation_n2:
            self._tested = True
            limit = SENSES.gain_sds * hypot(SENSES.gain_sd, SENSES.wander_n / sqrt(c.excitation))
            if abs(c.gain - 1) > limit:
                return _ft(f"gain {c.gain:.2f} by the weight of the tool, allowed 1 +- {limit:.2f}")
        elif not self._tested and depth is not None and depth > -SENSES.tested_above_m:
            return _ft("self-test incomplete before the first touch: the tool was not moved enough to weigh it")
        return []


class MotionAgreement:
    """Compares the measured positions with the integral of the measured velocities, over about half a second."""

    WINDOW_S: Final = 0.5
    LIMIT_RAD: Final = 0.03
    """Three times the error of a velocity that lags by 10 ms while it changes by 1 rad/s."""
    LATE_S: Final = 0.02
    """Positions may be as old as the contract allows for `joint_states`, and more or less so from one status to the next."""
    LONGEST_S: Final = 0.05
    """Between measurements that are farther apart the velocity is not known: the arm may have braked."""
    JUMP_RADPS: Final = 4.0
    """Faster than any joint: a jump, which other checks name."""
    AGAINST_RAD: Final = 1e-3
    """Minimum motion of a joint between two measurements whose velocity has the other sign: twice that of a velocity that lags by
    20 ms in a reversal of 5 rad/s^2."""

    def __init__(self) -> None:
        self._before: Measurement | None = None
        self._gap = np.zeros(0)
        self._against = 0
        self._fast = 0.0  # greatest speed within about the window [rad/s]

    def judge(self, measured: Measurement, since_s: float) -> list[Breach]:
        """Return the breaches at a measurement, `since_s` [s] after the one before."""
        before, self._before = self._before, measured
        moved = measured.q - (measured.q if before is None else before.q)
        if before is None or not 0 < since_s < self.LONGEST_S or _largest(moved) > self.JUMP_RADPS * since_s:
            self._gap = np.zeros_like(measured.q)
            return []
        turned = 0.5 * (measured.qd + before.qd) * since_s
        pairs = zip(moved.tolist(), turned.tolist(), strict=True)
        against = any(a * b < 0 and min(abs(a), abs(b)) > self.AGAINST_RAD for a, b in pairs)
        self._against = self._against + 1 if against else 0
        faded = exp(-since_s / self.WINDOW_S)
        self._fast = max(self._fast * faded, _largest(measured.qd))
        limit = self.LIMIT_RAD + self.LATE_S * self._fast
        most = limit + self.LIMIT_RAD  # within the window it is over once they agree, also after a fast motion
        self._gap = np.clip((self._gap + moved - turned) * faded, -most, most)
        if (apart := _largest(self._gap)) > limit:
            reason = f"positions and velocities disagree by {apart:.2f} rad, limit {limit:.2f} rad"
        elif self._against > 1:
            reason = "positions move against the velocities"
        else:
            return []
        return [Breach(StopLevel.EMERGENCY, StopCause.SENSOR, f"joint sensors: {reason}", culprit=STATUS)]


def _largest(x: Array) -> float:
    """Return the largest magnitude in a small array, faster than numpy does."""
    return float(max(map(abs, x.tolist())))


class DepthAgreement:
    """Compares the depth that planning states with that of the tool, by the joints, below the skin that planning states."""

    LIMIT_M: Final = 0.003
    """The tool moves by 0.5 mm between the two measurements."""
    MOST: Final = 10
    """Messages in a row beyond the limit."""

    def __init__(self, radius: float) -> None:
        """`radius` of the indenter [m]."""
        self._radius = radius
        self._wrong = 0
        self._one_frame = True

    def judge(self, state: Any, skin_W: tuple[Array, Array], p_W: Array) -> list[Breach]:
        """Return the breaches of an `exam/state`.

        `skin_W`: its point of the skin [m] and normal; `p_W`: centre of the sphere [m]; shapes (3,).
        """
        self._one_frame = self._one_frame and not state.patient_moved  # from then on the skin is given where it was before
        height = skin_W[1] @ (p_W - skin_W[0])
        gap = float(state.depth - (self._radius + state.wall_displacement - height))
        self._wrong = self._wrong + 1 if self._one_frame and state.in_contact and abs(gap) > self.LIMIT_M else 0
        if self._wrong < self.MOST:
            return []
        reason = f"exam/state: depth = {1e3 * state.depth:.1f} mm, {1e3 * gap:.1f} mm more than the joints and its skin say"
        return [Breach(StopLevel.EMERGENCY, StopCause.INVALID, reason, culprit=EXAM)]


def _ft(reason: str) -> list[Breach]:
    """Planning retreats: it needs no force for that."""
    return [Breach(StopLevel.SOFT_STOP, StopCause.SENSOR, f"F/T sensor: {reason}", SENSES.never_ns, culprit=FT)]


def _joints(reason: str) -> list[Breach]:
    """The driver holds: a retreat would rely on the joints."""
    return [Breach(StopLevel.EMERGENCY, StopCause.SENSOR, f"joint sensors: {reason}", culprit=JOINTS)]
