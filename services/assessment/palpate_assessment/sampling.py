"""States of the examination at 100 Hz to samples: one every few millimetres of travel, by averaging.

Planning counts depth from the forecast wall, displaced by f = m(x) w'(t), with the shape m of the breathing motion and the
forecast w' of perception, because images arrive a tenth of a second late. The assessment waits for them: they measure w(t), and

    d = d' + m(x) w(t) - f

is the depth d' corrected accordingly.
"""

from collections import deque
from collections.abc import Mapping, Sequence
from math import sqrt
from typing import Any, Final, NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from palpate_models.numerics.frames import Array
from palpate_models.scenario.load import FELT

TRAVEL = 0.005
"""Travel that one sample averages [m]: a third of the radius in which the indenter feels, so it blurs little."""
LONGEST = 0.4
"""Time that one sample averages at most [s], for an indenter that stands still."""
_FEWEST = 3
"""States that make a sample."""


class HeldPress(NamedTuple):
    """A press that is held before a slide begins: the standard press, felt itself."""

    states: int = 200
    """Latest states that are kept: descent and hold."""
    still_m: float = 0.0002
    """They are at one place if this close to the first."""
    deep: float = 0.95
    """Part of the last depth from which the hold counts."""
    read_s: tuple[float, float] = (0.32, 0.42)
    """Times from then on that are averaged: the standard press is read after 0.4 to 0.5 s, and descends in 0.5 instead of 0.67 s,
    so that the middle of its descent is 0.08 s later."""
    settled_m: float = 0.001
    """Maximum range of depths within these times."""
    rise: tuple[float, float] = (0.5, 0.97)
    """Parts of the last depth between which the exponent of the descent is fitted."""


PRESS = HeldPress()


class ContactState(NamedTuple):
    """Measurement of the examination at one instant, in the abdomen frame A."""

    time: float
    """[s]"""
    position: Array
    """Perceived rest surface point under the indenter [m], shape (3,)."""
    normal: Array
    """Outward unit normal there, shape (3,)."""
    depth: float
    """Indentation along the inward normal from the perceived rest surface [m]."""
    force: float
    """Tared normal force [N], positive when the wall is pressed."""
    in_contact: bool
    counts: bool
    """True if it belongs to a sample: in contact, at depth, outside transitions."""
    force_limited: bool = False
    stroke: int = 0
    """Number of the latest descent."""
    depth_uncertainty: float = 0.0
    """One sigma of the depth [m]."""
    followed: float = 0.0
    """Displacement by which set-point and depth followed the breathing skin [m]."""


class ForceSample(NamedTuple):
    """One measurement of force at depth, averaged over a few millimetres of travel, in A."""

    time: float
    """[s]"""
    position: Array
    """[m], shape (3,)."""
    normal: Array
    """Shape (3,)."""
    velocity: Array
    """Tangential velocity of the indenter [m/s], shape (3,)."""
    depth: float
    """[m]"""
    force: float
    """[N]"""
    force_noise: float
    """Standard error of the mean force [N]."""
    time_in_contact: float
    """Since the onset of contact of this stroke [s]."""
    force_limited: bool
    stroke: int = 0
    """Number of the descent: samples of one stroke share the zero of depth and of force."""
    depth_uncertainty: float = 0.0
    """One sigma of the depth [m]."""
    exponent: float = 0.0
    """n of F ~ depth^n in the descent to a held press; 0 for other samples."""


class Sampler:
    """Thins states to samples. Feed every state in order; a sample comes out now and then."""

    def __init__(self) -> None:
        self._block: list[ContactState] = []
        self._before: deque[ContactState] = deque(maxlen=PRESS.states)
        self._onset: float | None = None
        self._counted = False
        """True once a state of this touch has counted: a later rest is not its press, but a wait for the breath in its slide."""

    def add(self, state: ContactState) -> ForceSample | None:
        """Take the next state; return the sample that it completes, if any."""
        if not state.in_contact:
            sample = self._average()
            self.forget()
            return sample
        if self._onset is None:
            self._onset = state.time
        if not state.counts:
            if not self._counted:
                self._before.append(state)
            return self._average()
        self._counted = True
        self._block.append(state)
        if self._before:
            return self._press(state)
        first = self._block[0]
        way = state.position - first.position
        complete = sqrt(way.dot(way)) >= TRAVEL or state.time - first.time >= LONGEST
        return self._average() if complete else None

    def forget(self) -> None:
        """Forget the states of a sample that is not complete, and the touch."""
        self._block, self._onset, self._counted = [], None, False
        self._before.clear()

    def _press(self, state: ContactState) -> ForceSample | None:
        """Return the press that was held before the indenter slid to `state`, if one was."""
        before = list(self._before)
        self._before.clear()
        place = np.array([s.position for s in before])
        held = [s for s, p in zip(before, place, strict=True) if np.linalg.norm(p - place[0]) < PRESS.still_m]
        if len(held) == len(before) and np.linalg.norm(state.position - place[0]) < PRESS.still_m:
            return None  # it does not slide
        if held[-1].depth <= 0:
            return None  # it is above the skin that is perceived
        deep = next(s.time for s in held if s.depth > PRESS.deep * held[-1].depth)
        read = [s for s in held if PRESS.read_s[0] <= s.time - deep <= PRESS.read_s[1]]
        depths = [s.depth for s in read]
        complete = len(read) > 0 and held[-1].time - deep >= PRESS.read_s[1] and max(depths) - min(depths) < PRESS.settled_m
        sample = self._average_of(read) if complete else None
        fall = np.array([(s.depth, s.force) for s in held if s.time <= deep and s.force > 0])
        fall = fall[(fall[:, 0] > PRESS.rise[0] * held[-1].depth) & (fall[:, 0] < PRESS.rise[1] * held[-1].depth)]
        if sample is None or len(fall) < _FEWEST:
            return sample
        log_depth, log_force = np.log(fall.T)
        return sample._replace(exponent=float(np.polyfit(log_depth, log_force, 1)[0]))

    def _average(self) -> ForceSample | None:
        """Return the sample of the present block, and begin the next one."""
        block, self._block = self._block, []
        return self._average_of(block)

    def _average_of(self, block: Sequence[ContactState]) -> ForceSample | None:
        if len(block) < _FEWEST or self._onset is None:
            return None
        time = np.array([s.time for s in block])
        position = np.array([s.position for s in block])
        depth = np.array([s.depth for s in block])
        force = np.array([s.force for s in block])
        normal = np.array([s.normal for s in block]).mean(axis=0)
        normal /= np.linalg.norm(normal)
        centred = time - time.mean()
        slope = centred / (centred @ centred)
        velocity = slope @ position
        rest = force - force.mean() - centred * float(slope @ force)
        middle = position.mean(axis=0)
        return ForceSample(
            time=float(time.mean()),
            position=middle,
            normal=normal,
            velocity=velocity - normal * float(normal @ velocity),
            depth=float(depth.mean()),
            force=float(force.mean()),
            force_noise=float(np.sqrt(rest @ rest / max(len(block) - 2, 1) / len(block))),
            time_in_contact=float(time.mean()) - self._onset,
            force_limited=any(s.force_limited for s in block),
            stroke=block[0].stroke,
            depth_uncertainty=max(s.depth_uncertainty for s in block),
        )


def columns(samples: Sequence[ForceSample], before: float) -> dict[str, Any]:
    """Samples as a checkpoint keeps them, with times before `before` [s], at which their examination ended."""
    felt = {name: np.array([getattr(sample, name) for sample in samples]) for name in FELT}
    return felt | {"time": felt["time"] - before}


def samples_of(felt: Mapping[str, Any]) -> list[ForceSample]:
    """Return the samples of a checkpoint."""
    plain = (felt[name] if felt[name].ndim > 1 else felt[name].tolist() for name in FELT)
    return [ForceSample(*row) for row in zip(*plain, strict=True)]


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
