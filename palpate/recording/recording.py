"""A recording of palpation, by any robot, as contacts with a body."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from functools import cached_property
from math import sqrt
from typing import Final, NamedTuple

import numpy as np

from palpate.recording.cutting import FOOTPRINT_SHARE, windows
from palpate_assessment.sampling import ForceSample
from palpate_assessment.standard import USUAL, PressStandard
from palpate_models.numerics.frames import Array

ANY_BODY: Final = (1.4, 1.0)
"""Mean and SD of the exponents of force over depth."""
LOADING_SHARE: Final = 0.5
"""Readings from this share of the depth on count."""


class FaultCode(StrEnum):
    """Kinds of faults: the code and its text."""

    text: str

    def __new__(cls, code: str, text: str) -> "FaultCode":
        """Return the member of a code."""
        member = str.__new__(cls, code)
        member._value_, member.text = code, text
        return member

    SIGN = "sign", "the force pulls where the tool presses: its sign is wrong, see force.on of the mapping"
    UNIT = "unit", "a contact travels {value:.3g} m, which does not suit the tool's radius: see units.length of the mapping"
    FORCE_UNIT = "force_unit", "a press needs {value:.3g} N, which does not suit a soft body: see units of the mapping"
    TIME_UNIT = "time_unit", "there is a row every {value:.3g} s: see units.time of the mapping"
    SPEED = "speed", "the tool moves at {value:.3g} m/s: see units.length and units.time of the mapping"
    STIFFNESS = "stiffness", "a press is as on a body of {value:.2g} kPa, which is rare: see units and tool.radius_m"
    MISSING = "missing", "{count} of {of} rows have {value:g} for a missing number"
    SPIKE = "spike", "{count} of {of} forces jump by up to {value:.3g} N for one row or two"
    GAP = "gap", "time jumps by up to {value:.3g} s at {count} of {of} rows"
    RESOLUTION = "resolution", "the force has steps of {value:.2g} N"
    FRAME = "frame", "the force is {value:.0f} deg off the direction of pressing: see force.axes and table.quaternion"
    NO_FREE_AIR = "no_free_air", "no part of the recording is free of contact, so that the force cannot be tared"
    DRIFT = "drift", "the force drifts by {value:.2g} N between the first and the last free motion"
    CLIPPED = "clipped", "{count} of {of} samples are at the end of the sensor's range ({value:.3g} N)"
    FROZEN = "frozen", "{count} of {of} samples repeat a force while the tool moves: the sensor froze"
    REPEATED = "repeated", "{count} of {of} rows are there twice"
    CLOCK = "clock", "force and position are {value:.3g} s apart"
    BACKWARD = "backward", "time goes back at {count} of {of} rows"
    ORDER = "order", "the rows of {count} of {of} probes are out of order"
    LINE = "line", "{count} of {of} contacts lie on one line, so that nothing is known aside of it: see table.position"
    NORMALS = "normals", "the normals point into the body"
    COARSE = "coarse", "{count} of {of} rows have the time of the row before them: they are spread evenly"
    NO_CONTACT = "no_contact", "{count} of {of} contacts never touch"
    NOTHING = "nothing", "no contact is recognised: the force nowhere rises over its noise"
    JUMP = "jump", "{count} of {of} positions jump by up to {value:.3g} m"
    TWO_TOOLS = "two_tools", "every other position is {value:.3g} m away: the table has the rows of two tools"
    DISAGREE = "disagree", "{count} of {of} contacts disagree with others at the same place"
    SHALLOW = "shallow", "{count} of {of} contacts are too shallow to be assessed"
    INVALID = "invalid", "{count} of {of} rows have no pose, no number, or a normal of length 0"
    MOVES = "moves", "the skin is {value:.2g} m elsewhere from slide to slide: the body moves, as it does in breathing"
    ANATOMY = "anatomy", "body.anatomy is abdomen, but its frame was fitted to the contacts: see body.pose of the mapping"
    ZERO = "zero", "the force is {value:.2g} N where probes begin: it was not tared"


class Remedy(StrEnum):
    """Actions on a fault."""

    LEFT_OUT = "left out"
    KEPT = "kept as they are"
    CORRECTED = "corrected"
    NOT_TARED = "the force is taken as it is, without a tare"
    NO_ANATOMY = "no anatomy is assumed"
    ONE_DEPTH = "all slides are taken to keep one depth"
    REFUSED = "not assessed until it is fixed"


@dataclass(frozen=True)
class Fault:
    """A fault that was found in a recording."""

    code: FaultCode
    count: int
    """Affected rows, contacts or samples."""
    of: int
    """All of them."""
    remedy: Remedy
    value: float = 0.0
    """Size, in the unit of the text."""

    @property
    def text(self) -> str:
        """One line for the user."""
        return f"{self.code.text.format(count=self.count, of=self.of, value=self.value)}; {self.remedy}"


def is_refused(faults: Iterable[Fault]) -> bool:
    """Return True if nothing is assessed for one of the faults."""
    return any(fault.remedy is Remedy.REFUSED for fault in faults)


class ContactKind(StrEnum):
    """Motions of the tool in contact."""

    PROBE = "probe"
    """Motion in and out at one place, without time."""
    PRESS = "press"
    """Motion in and out at one place, over time."""
    SLIDE = "slide"
    """Along the skin."""


@dataclass(frozen=True, eq=False)
class Contact:
    """One touch of the body from its onset to its end; k readings, in the body frame A."""

    kind: ContactKind
    position: Array
    """Points of the unpressed skin under the tool, as believed [m], shape (k, 3)."""
    normal: Array
    """Outward unit normals there, shape (k, 3)."""
    depth: Array
    """Depth of the tool's lowest point below the unpressed skin [m], shape (k,)."""
    force: Array
    """Along the outward normal, positive when the tool presses [N], shape (k,)."""
    depth_uncertainty: float
    """One SD of the zero of the depth [m]."""
    force_noise: float
    """SD of the force's white noise [N]."""
    time: Array | None = None
    """[s], shape (k,); None for a probe."""


class Palpated(NamedTuple):
    """Contacts and skin found in readings, in A."""

    contacts: Sequence[Contact] = ()
    surface: Callable[[Sequence[Contact]], tuple[Array, Array]] = lambda contacts: (np.empty((0, 3)), np.empty((0, 3)))
    """Points [m] and normals of the skin about some of the contacts, shape (n, 3) each."""
    exponent: float = 1.5
    """Power of depth that the force follows."""
    untold: int = 0
    """Contacts whose depth is not known."""


class Loading(NamedTuple):
    """Presses of one body; k of them."""

    force: Array
    """At the depth of each [N], shape (k,)."""
    noise: Array
    """SE of it [N], shape (k,)."""
    depth: list[float]
    """[m]"""
    exponent: float
    """Median of n."""
    exponent_sd: float
    """Spread of n from press to press."""


def loading(presses: Sequence[Contact], depth_m: float) -> Loading:
    """Return the forces of presses at a depth, of those that do not reach it at the depth that they reach.

    F = F_D (d / D)^n, with exponents n that scatter about the body's own: each press has its force F_D and exponent n_i by
    non-linear least squares, with the prior n_i ~ N(n, s^2). n and s are those of the body: median and spread of the exponents
    that presses have of their own, less what noise adds to the spread (empirical Bayes).
    """
    ends = [min(depth_m, float(press.depth.max())) for press in presses]
    rows = []
    for press, end in zip(presses, ends, strict=True):
        depth, force = press.depth, press.force
        near = (depth >= LOADING_SHARE * end) & (depth <= 1.1 * end)
        near = near if near.any() else np.abs(depth - end) == np.abs(depth - end).min()
        rows.append((np.log(np.maximum(depth[near], 1e-6) / end), force[near], press.force_noise))
    own = [_fit(*row, *ANY_BODY) for row in rows if len(row[0]) > 2]
    mean, spread = ANY_BODY
    if own:
        exponents, variances = np.array([(found[1], found[3]) for found in own]).T
        mean = float(np.median(exponents))
        scatter = 1.4826 * float(np.median(np.abs(exponents - mean)))
        spread = float(np.sqrt(max(scatter**2 - float(np.median(variances)), 1e-4)))
    found = np.array([_fit(*row, mean, spread) for row in rows]).reshape(-1, 4)
    return Loading(found[:, 0], found[:, 2], ends, mean, spread)


def _fit(log_depth: Array, force: Array, noise: float, mean: float, spread: float) -> tuple[float, float, float, float]:
    """Return force at the depth [N] and exponent of a press, the SE of the force [N], and the exponent's variance."""
    level, exponent = float(force[np.argmax(log_depth)]), mean
    weight = 1.0 / max(noise, 1e-6) ** 2
    for _ in range(8):
        shape = np.exp(exponent * log_depth)
        slopes = np.column_stack((shape, level * shape * log_depth))
        information = weight * slopes.T @ slopes + np.diag((1e-12, 1.0 / spread**2))
        pull = weight * slopes.T @ (force - level * shape) + np.array((0.0, (mean - exponent) / spread**2))
        change = np.linalg.solve(information, pull)
        level, exponent = level + float(change[0]), exponent + float(np.clip(change[1], -0.5, 0.5))
    covariance = np.linalg.inv(information)
    return level, exponent, float(np.sqrt(covariance[0, 0])), float(covariance[1, 1])


@dataclass(frozen=True, eq=False)
class PalpationRecording:
    """Contacts of one body."""

    name: str
    indenter_radius_m: float
    touches: tuple[Contact, ...] = ()
    surface: Array = field(default_factory=lambda: np.empty((0, 3)))
    """Points of the unpressed skin [m], shape (n, 3), in A."""
    normals: Array = field(default_factory=lambda: np.empty((0, 3)))
    """Outward unit normals there, shape (n, 3)."""
    X_WA: Array = field(default_factory=lambda: np.eye(4))
    """Pose of A in the frame of the recording's positions, shape (4, 4)."""
    faults: tuple[Fault, ...] = ()
    abdomen: bool = False
    """True if the body is an abdomen and A is at its umbilicus; else no anatomy is assumed."""
    exponent: float = 1.5
    """Power of depth that the force of its contacts follows."""

    @cached_property
    def depth_m(self) -> float:
        """Nominal depth: the median of the presses' maximum depth, of slides their usual one [m]."""
        return float(np.median([t.depth.max() if t.kind is not ContactKind.SLIDE else np.median(t.depth) for t in self.touches]))

    def samples(self, depth_m: float | None = None) -> list[ForceSample]:
        """Return the forces at a depth [m], by default the nominal one: one per press or probe, one per footprint of a slide.

        A contact that does not reach the depth gives its force at the depth that it reaches.
        """
        if not self.touches:
            return []
        nominal = self.depth_m if depth_m is None else depth_m
        presses = self._presses
        force, noise, depth, *_ = loading(list(presses.values()), nominal)
        samples = [
            _press_sample(touch, number, *load)
            for (number, touch), load in zip(presses.items(), zip(force, noise, depth, strict=True), strict=True)
        ]
        for number, touch in enumerate(self.touches, start=1):
            if touch.kind is ContactKind.SLIDE:
                samples += _slide_samples(touch, number, FOOTPRINT_SHARE * sqrt(self.indenter_radius_m * nominal))
        return sorted(samples, key=lambda sample: sample.stroke)

    @property
    def standard(self) -> PressStandard:
        """The press that the map is of: the abdomen's, or of another body the recorded ones at their nominal depth."""
        if self.abdomen:
            return USUAL
        exponent, spread = self.exponent, 0.0
        if presses := list(self._presses.values()):
            *_, exponent, spread = loading(presses, self.depth_m)
        return PressStandard.of(self.samples(), self.indenter_radius_m, exponent, spread)

    @property
    def _presses(self) -> dict[int, Contact]:
        """Presses and probes that reached any depth, by number."""
        touches = enumerate(self.touches, start=1)
        return {number: touch for number, touch in touches if touch.kind is not ContactKind.SLIDE and touch.depth.max() > 0}


def width(places: Array) -> float:
    """Return the extent of places across the line through them in the xy plane [m]; `places` [m], shape (n, 3)."""
    xy = places[:, :2] - places[:, :2].mean(axis=0)
    return float(np.ptp(xy @ np.linalg.svd(xy, full_matrices=True)[2][1]))


def implied_young(touches: Sequence[Contact], radius: float) -> tuple[float, float]:
    """Return the plane-strain modulus of a half-space that needs the forces of contacts [Pa] (Hertz), and their force [N]."""
    highest = [np.quantile(np.maximum((touch.depth, touch.force), 1e-9), 0.95, axis=1) for touch in touches]
    moduli = [0.75 * force / np.sqrt(radius * depth**3) for depth, force in highest]
    return float(np.median(moduli)), float(np.median([force for _, force in highest]))


def _press_sample(touch: Contact, number: int, force: float, noise: float, depth: float) -> ForceSample:
    """Return the sample of a press or probe."""
    last = int(np.flatnonzero(touch.depth >= 0.95 * depth)[0])
    # probes without time are 10 s apart: their errors of one moment are unrelated
    time = 10.0 * number if touch.time is None else float(touch.time[last])
    return ForceSample(
        time=time,
        position=touch.position[last],
        normal=touch.normal[last],
        velocity=np.zeros(3),
        depth=depth,
        force=float(force),
        force_noise=float(noise),
        time_in_contact=0.0 if touch.time is None else time - float(touch.time[0]),
        force_limited=False,
        stroke=number,
        depth_uncertainty=touch.depth_uncertainty,
    )


def _slide_samples(touch: Contact, number: int, travel: float) -> list[ForceSample]:
    """Return a sample per `travel` [m] of a slide: the force at the mean depth, by regression over the depths there."""
    assert touch.time is not None
    samples = []
    for part in windows(touch.position, travel):
        time, depth, force = touch.time[part], touch.depth[part], touch.force[part]
        off = depth - depth.mean()
        slope = float(off @ force) / max(float(off @ off), 1e-18)
        rest = force - force.mean() - slope * off
        velocity = (touch.position[part[-1]] - touch.position[part[0]]) / max(float(time[-1] - time[0]), 1e-9)
        samples.append(
            ForceSample(
                time=float(time.mean()),
                position=touch.position[part].mean(axis=0),
                normal=touch.normal[part[len(part) // 2]],
                velocity=velocity,
                depth=float(depth.mean()),
                force=float(force.mean()),
                force_noise=float(np.sqrt(rest @ rest / max(len(part) - 2, 1) / len(part))),
                time_in_contact=float(time.mean() - touch.time[0]),
                force_limited=False,
                stroke=number,
                depth_uncertainty=touch.depth_uncertainty,
            )
        )
    return samples
