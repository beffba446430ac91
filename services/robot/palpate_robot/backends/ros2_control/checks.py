"""Two checks of an arm that takes commands: it follows them, and its force pushes the tool away at the first contact."""

from collections import deque
from typing import Final, NamedTuple

import numpy as np

from palpate_bus.messages import NS
from palpate_models.numerics.frames import Array


class CheckTuning(NamedTuple):
    """Constants of the checks (assumed)."""

    window_s: float = 0.3
    """Commands of this time count, and a deviation lasts as long before it is reported: an arm at level position lags by less."""
    every_s: float = 0.02
    position_rad: float = 0.02
    """Maximum distance of a measured position from all commanded ones of the window."""
    torque_nm: float = 6.0
    """Maximum distance of a torque from all commanded ones: more than friction, load data and sensors of an arm cause."""
    pose_m: float = 0.1
    """Maximum distance of the tool's pose under a Cartesian impedance of the stack: a spring that yields."""
    contact_n: float = 2.0
    """Change of the external force that counts as a contact: beyond noise and inertia of the tool."""
    baseline_s: float = 2.0
    """Time constant of the force in free motion."""
    axial: float = 0.5
    """Minimum share of the force along the tool for a verdict: a push from the side says nothing."""


TUNING: Final = CheckTuning()


class FollowCheck:
    """Checks if measurements follow commands."""

    def __init__(self, tolerance: float) -> None:
        self._tolerance = tolerance
        self._recent: deque[tuple[int, Array]] = deque()
        self._since: int | None = None

    def reset(self) -> None:
        """Forget what was commanded, as after a hold."""
        self._recent.clear()
        self._since = None

    def stray(self, t: int, command: Array, measured: Array) -> int | None:
        """Take a command and a measurement at `t` [ns], shapes (n,); return the component that does not follow, or None."""
        recent = self._recent
        if recent and t - recent[-1][0] < TUNING.every_s * NS:
            return None
        recent.append((t, command))
        while t - recent[0][0] > TUNING.window_s * NS:
            recent.popleft()
        commands = np.array([values for _, values in recent])
        off = np.maximum(measured - commands.max(axis=0), commands.min(axis=0) - measured)
        worst = int(np.argmax(off))
        if not off[worst] > self._tolerance:
            self._since = None
            return None
        self._since = t if self._since is None else self._since
        return worst if t - self._since >= TUNING.window_s * NS else None


class FirstContactCheck:
    """Checks once that the force of the first contact pushes the tool back along its axis, which points out of the flange."""

    def __init__(self) -> None:
        self.passed = False
        self._baseline: Array | None = None
        self._at = 0

    def wrong(self, t: int, force_S: Array) -> bool:
        """Take the external force at `t` [ns] in the sensor's axes [N], shape (3,); return True if it pulls the tool out."""
        if self.passed:
            return False
        if self._baseline is None:
            self._baseline, self._at = force_S, t
        change = force_S - self._baseline
        size = float(np.linalg.norm(change))
        if size < TUNING.contact_n or abs(change[2]) < TUNING.axial * size:
            share = 1.0 - np.exp(-(t - self._at) / NS / TUNING.baseline_s)
            self._baseline, self._at = self._baseline + share * change, t
            return False
        self.passed = bool(change[2] < 0)
        return not self.passed
