"""Compares measurements with the scenario's limits. Numbers in, breaches out."""

from collections import deque
from typing import NamedTuple

import numpy as np

from palpate_bus.messages.codes import HoldCause, StopCause, StopLevel
from palpate_models.numerics.frames import Array
from palpate_models.scenario.schema import Limits
from palpate_supervisor.tool import Tool


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


TUNING = SupervisorTuning()


class Breach(NamedTuple):
    """A limit that is violated now. `cause` is the code to act on; `reason` is text for people."""

    level: StopLevel
    cause: StopCause
    reason: str
    timeout_ns: int = TUNING.soft_stop_timeout_ns
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
        self._forces: deque[tuple[int, float]] = deque(maxlen=TUNING.rate_samples + 1)
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
        rate = (force - before) / ((stamp - begin) / 1e9) if len(forces) > TUNING.rate_samples else 0.0
        soon = force + (rate * TUNING.lookahead_s if rate > TUNING.fast_nps else 0.0)
        if force <= limits.force_soft_stop_n:
            self._over_since = None
        elif self._over_since is None:
            self._over_since = t
        rising = soon > limits.force_soft_stop_n and rate > TUNING.fast_nps
        lasting = self._over_since is not None and t - self._over_since >= TUNING.force_patience_ns
        if not (rising or lasting) and soon <= limits.force_emergency_n:
            return []
        found = f"external force {force:.1f} N, rising at {rate:.0f} N/s" if rate > 0 else f"external force {force:.1f} N"
        level, limit = StopLevel.SOFT_STOP, f"soft-stop limit {limits.force_soft_stop_n:g} N"
        if not soon <= limits.force_emergency_n:
            level, limit = StopLevel.EMERGENCY, f"emergency limit {limits.force_emergency_n:g} N"
        timeout = TUNING.rising_timeout_ns if rising else TUNING.soft_stop_timeout_ns
        return [Breach(level, StopCause.FORCE, f"{found}, {limit}", timeout, soon - limits.force_soft_stop_n)]

    def _depth(self, depth: float) -> list[Breach]:
        limit = self._limits.depth_m + TUNING.depth_margin_m
        if depth <= limit:
            return []
        level = StopLevel.EMERGENCY if depth > limit + TUNING.depth_margin_m else StopLevel.SOFT_STOP
        reason = f"depth {depth * 1e3:.1f} mm below the perceived surface, limit {limit * 1e3:.1f} mm"
        return [Breach(level, StopCause.DEPTH, reason, beyond=depth - limit)]

    def _speed(self, speed: float, force: float) -> list[Breach]:
        free = self._limits.speed_mps * TUNING.speed_margin
        if not speed <= free:  # also for NaN
            reason = f"robot/status: tool speed {speed:.2f} m/s, limit {free:.2f} m/s"
            return [Breach(StopLevel.EMERGENCY, StopCause.SPEED, reason, culprit="robot/status")]
        contact = self._limits.contact_speed_mps
        if force > TUNING.contact_n and speed > contact:
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
