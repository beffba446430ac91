"""What is judged: measured values against the scenario's limits. Numbers in, breaches out."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from palpate_models.numerics.frames import Array
from palpate_models.scenario.schema import Limits
from palpate_supervisor.tool import Tool

LOOKAHEAD_S = 0.1
"""A force that will be over its limit so much later counts as over it: a retreat takes 30 to 50 ms to begin, a hold that follows
a retreat that nobody began as much again."""
HEED = 200_000_000
"""A soft stop whose cause is still there so much later [ns] has not been heeded ..."""
HEED_RISING = 40_000_000
"""... and one for a force that is still rising fast so much later."""
FAST_NPS = 30.0
"""Only a force that rises faster than this is judged by where it will be [N/s]; slower ones planning can deal with."""
RATE_SAMPLES = 3
"""The rate of force is taken over so many measurements."""
PATIENCE = 50_000_000
"""Planning retreats by itself at the soft limit; the supervisor steps in when the force stays over it for so long [ns]."""
SPEED_MARGIN = 1.3
"""Free motion is planned to reach `speed_mps`; the arm overshoots it by some percent."""
DEPTH_MARGIN_M = 0.025
"""How wrong the perceived surface may be, by which depth is judged here. Camera and arm together are off by a standard deviation
of about 7 mm (5.6 mm the camera alone, 12 patients of tuning seeds; touches lay up to 13 mm inward, 6 examinations), and this is
three of these and what following leaves. Planning counts depth from where the skin is touched; this does not depend on that."""
CONTACT_N = 5.0
"""Force that is surely contact: the tool's inertia takes 1.4 N at 4 m/s^2, and a sensor that warms up drifts by 2 N."""


class Level(IntEnum):
    """Values of `palpation_msgs/SupervisorState.level`."""

    OK = 0
    SOFT_STOP = 1
    EMERGENCY = 2


class Cause(IntEnum):
    """Values of `palpation_msgs/SupervisorState.cause`."""

    NONE = 0
    FORCE = 1
    DEPTH = 2
    SPEED = 3
    WORKSPACE = 4
    LOST = 5
    SILENT = 6
    INVALID = 7
    OPERATOR = 8
    DRIVER = 9
    UNHEEDED = 10


@dataclass(frozen=True, slots=True)
class Breach:
    """A limit that does not hold now."""

    level: Level
    cause: Cause
    reason: str
    heed: int = HEED
    """How long a soft stop for it may take to help [ns]."""
    beyond: float = 0.0
    """How far the tool is beyond the limit [m], of depth and of the workspace."""


class LimitWatch:
    """Judges the tool, at every measurement."""

    def __init__(self, limits: Limits, X_AW: Array) -> None:
        """`X_AW`: world in the abdomen frame, in which the workspace is given, shape (4, 4)."""
        self._limits = limits
        self._R_AW, self._p_AW = X_AW[:3, :3], X_AW[:3, 3]
        self._forces: deque[tuple[int, float]] = deque(maxlen=RATE_SAMPLES + 1)
        self._over_since: int | None = None

    def judge(self, tool: Tool, depth: float | None, stamp: int, t: int) -> list[Breach]:
        """Breaches at `t` [ns] of what was measured at `stamp` [ns]; `depth` [m] below the perceived surface, None while none is
        known.
        """
        p_W, speed, force = tool
        found = self._force(force, stamp, t) + self._speed(speed, force) + self._workspace(p_W)
        return found if depth is None else found + self._depth(depth, force)

    def _force(self, force: float, stamp: int, t: int) -> list[Breach]:
        limits, forces = self._limits, self._forces
        if forces and stamp <= forces[-1][0]:  # the same measurement again, or a clock that was set back: it has no rate
            forces.clear()
        forces.append((stamp, force))
        begin, before = forces[0]
        rate = (force - before) / ((stamp - begin) / 1e9) if len(forces) > RATE_SAMPLES else 0.0
        soon = force + (rate * LOOKAHEAD_S if rate > FAST_NPS else 0.0)
        if force <= limits.force_soft_stop_n:
            self._over_since = None
        elif self._over_since is None:
            self._over_since = t
        rising = soon > limits.force_soft_stop_n and rate > FAST_NPS
        lasting = self._over_since is not None and t - self._over_since >= PATIENCE
        if not (rising or lasting) and soon <= limits.force_emergency_n:
            return []
        words = f"external force {force:.1f} N, rising at {rate:.0f} N/s" if rate > 0 else f"external force {force:.1f} N"
        if not soon <= limits.force_emergency_n:
            return [Breach(Level.EMERGENCY, Cause.FORCE, f"{words}, emergency limit {limits.force_emergency_n:g} N")]
        heed = HEED_RISING if rising else HEED
        return [Breach(Level.SOFT_STOP, Cause.FORCE, f"{words}, soft-stop limit {limits.force_soft_stop_n:g} N", heed)]

    def _depth(self, depth: float, force: float) -> list[Breach]:
        limit = self._limits.depth_m + DEPTH_MARGIN_M
        if depth <= limit or force <= CONTACT_N:
            return []  # without a force there is no tissue there: the arm is beside the abdomen, which the workspace watches
        level = Level.EMERGENCY if depth > limit + DEPTH_MARGIN_M else Level.SOFT_STOP
        words = f"depth {depth * 1e3:.1f} mm below the perceived surface, limit {limit * 1e3:.1f} mm"
        return [Breach(level, Cause.DEPTH, words, beyond=depth - limit)]

    def _speed(self, speed: float, force: float) -> list[Breach]:
        free = self._limits.speed_mps * SPEED_MARGIN
        if not speed <= free:  # NaN, too
            words = f"robot/status: tool moves at {speed:.2f} m/s, limit {free:.2f} m/s"
            return [Breach(Level.EMERGENCY, Cause.SPEED, words)]
        contact = self._limits.contact_speed_mps
        if force > CONTACT_N and speed > contact:
            words = f"robot/status: tool moves at {speed:.2f} m/s with {force:.1f} N on it"
            words += f", limit in contact {contact:.2f} m/s"
            return [Breach(Level.EMERGENCY, Cause.SPEED, words)]
        return []

    def _workspace(self, p_W: Array) -> list[Breach]:
        p_A, low, high = self._R_AW @ p_W + self._p_AW, self._limits.workspace_min_m, self._limits.workspace_max_m
        beyond = np.maximum(low - p_A, p_A - high)
        k = int(np.argmax(beyond))  # of NaN, too
        if beyond[k] <= 0.0:
            return []
        words = f"tool at {'xyz'[k]} = {p_A[k]:.3f} m in the abdomen frame, allowed {low[k]:g} to {high[k]:g} m"
        return [Breach(Level.EMERGENCY, Cause.WORKSPACE, words, beyond=float(beyond[k]))]
