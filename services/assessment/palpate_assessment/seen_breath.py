"""Depth corrected by the measured breathing.

Planning counts depth from the forecast wall, displaced by f = m(x) w'(t), with the shape m of the breathing motion and the
forecast w' of perception, because images arrive a tenth of a second late. The assessment waits for them: they measure w(t), and

    d = d' + m(x) w(t) - f

is the depth d' corrected accordingly.
"""

from collections import deque
from collections.abc import Sequence
from typing import Final

import numpy as np
from scipy.spatial import cKDTree

from palpate_assessment.sampling import ContactState
from palpate_models.numerics.frames import Array

LONGEST_S: Final = 0.5
"""Maximum gap between images for interpolation [s], and longest wait of a state for the next image."""
IMAGES: Final = 40
"""Number of images kept, 4 s."""


def depth_seen(time: Array, depth: Array, followed: Array, share: Array, images: tuple[Array, Array]) -> Array:
    """Return depths [m] at times [s] corrected by images, shape (n,) each; unchanged where no image is near.

    `followed`: displacement that the set-point followed there [m]; `share`: m there; `images`: times of exposure [s], ascending,
    and the largest displacement of the wall [m], shape (k,) each.
    """
    exposed, displacement = images
    if len(exposed) < 2:
        return depth
    after = np.clip(np.searchsorted(exposed, time), 1, len(exposed) - 1)
    between = (exposed[after - 1] <= time) & (time <= exposed[after]) & (exposed[after] - exposed[after - 1] <= LONGEST_S)
    return np.where(between, depth + share * np.interp(time, exposed, displacement) - followed, depth)


class BreathingShares:
    """Breathing amplitude of each place of the perceived surface, 1 at its largest."""

    def __init__(self, vertices: Array, breathing: Array) -> None:
        """Vertices [m], shape (n, 3), and their share of the motion, (n,); empty where the wall is not known to move."""
        self._vertices, self._breathing = cKDTree(vertices), breathing

    def __call__(self, points: Array) -> Array:
        """Return the share at points of the surface [m], in the frame of the vertices, shape (k, 3) -> (k,)."""
        if not len(self._breathing):
            return np.zeros(len(points))
        return np.asarray(self._breathing[self._vertices.query(points)[1]])


class SeenBreath:
    """Holds states back until the breath of their moment has been seen."""

    def __init__(self) -> None:
        self._exposed: deque[float] = deque(maxlen=IMAGES)
        self._displacement: deque[float] = deque(maxlen=IMAGES)
        self._shares: BreathingShares | None = None
        self._waiting: list[ContactState] = []

    def perceive(self, vertices: Array, breathing: Array) -> None:
        """Take the perceived surface, in A: vertices and their shares as `BreathingShares` has them."""
        self._shares = BreathingShares(vertices, breathing)

    def add_image(self, exposed: float, displacement: float) -> None:
        """An image exposed at a time [s] shows the wall displaced so far where it moves most [m]."""
        self._exposed.append(exposed)
        self._displacement.append(displacement)

    def take(self, state: ContactState) -> None:
        """Take the next state."""
        self._waiting.append(state)

    def forget(self) -> None:
        """Discard waiting states."""
        self._waiting.clear()

    def take_settled(self, at_once: bool = False) -> list[ContactState]:
        """States that need not wait any longer, in order: their breath was seen, no image comes, or all are wanted `at_once`."""
        if not self._waiting:
            return []
        newest = self._waiting[-1].time
        until = newest - LONGEST_S if self._follows(newest) and not at_once else newest
        until = max(until, self._exposed[-1]) if self._exposed else until
        count = sum(state.time <= until for state in self._waiting)
        ready, self._waiting = self._waiting[:count], self._waiting[count:]
        return self._with_measured_breath(ready)

    def _follows(self, t: float) -> bool:
        """Return True if a later image is expected."""
        return self._shares is not None and bool(self._exposed) and t - self._exposed[-1] <= LONGEST_S

    def _with_measured_breath(self, states: Sequence[ContactState]) -> list[ContactState]:
        if self._shares is None or not states:
            return list(states)
        time, depth, followed = np.array([(state.time, state.depth, state.followed) for state in states]).T
        share = self._shares(np.array([state.position for state in states]))
        depths = depth_seen(time, depth, followed, share, (np.array(self._exposed), np.array(self._displacement)))
        return [state._replace(depth=float(d)) for state, d in zip(states, depths, strict=True)]
