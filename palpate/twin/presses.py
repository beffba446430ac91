"""The presses of a recording, and the same presses on a simulated wall.

A slide counts, once per footprint, as a press that lasts as long as the tool needs to cross its footprint, since that is how long
the tissue under it is loaded.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import sqrt
from typing import Final

import numpy as np

from palpate.recording.recording import Contact, ContactKind, PalpationRecording
from palpate_assessment.sampling import ForceSample
from palpate_errors import UserError
from palpate_models.numerics.frames import Array
from palpate_models.patient.phantom import PhantomModel
from palpate_models.patient.schema import Stiffness
from palpate_tissue.backends.winkler.presses import Course, contracted, press_forces, prony_table


@dataclass(frozen=True)
class PressLimits:
    """Bounds on the presses of a recording."""

    readings: int = 8
    """Readings of a press at most."""
    slide_steps: int = 4
    probe_step_s: float = 10.0
    """Time between the readings of a probe, whose time is unknown: nothing of the dashpot's force is left."""
    least: int = 20
    """Least number of presses."""
    most: int = 800
    """Presses that are fitted at most."""


LIMITS: Final = PressLimits()


@dataclass(frozen=True, eq=False)
class FittedPress:
    """One press; n readings in the order of time, in A."""

    place: Array
    """Point of the unpressed skin [m], shape (3,)."""
    time: Array
    """From the touch [s], shape (n,)."""
    depth: Array
    """[m], shape (n,)."""
    force: Array
    """[N], shape (n,); NaN where a slide was not measured."""
    timed: bool
    """False for a probe."""

    @property
    def deepest(self) -> int:
        """Index of the last reading near the greatest depth."""
        return int(np.flatnonzero(self.depth >= 0.95 * self.depth.max())[-1])

    @property
    def felt(self) -> float:
        """Force there [N]."""
        return float(self.force[self.deepest])


def presses_of(recording: PalpationRecording) -> list[FittedPress]:
    """Return the presses of a recording, thinned evenly to the most that are fitted. Raises UserError if there are too few."""
    slides = {n for n, touch in enumerate(recording.touches, start=1) if touch.kind is ContactKind.SLIDE}
    presses = [_pressed(touch) for touch in recording.touches if touch.kind is not ContactKind.SLIDE and touch.depth.max() > 0]
    if slides:
        radius = recording.indenter_radius_m
        presses += [_slid(sample, radius) for sample in recording.samples() if sample.stroke in slides and sample.depth > 0]
    presses = [press for press in presses if press.felt > 0]
    if len(presses) < LIMITS.least:
        raise UserError(f"{recording.name}: {len(presses)} presses with a force, at least {LIMITS.least} are needed for a twin")
    chosen = np.unique(np.linspace(0, len(presses) - 1, min(len(presses), LIMITS.most)).round().astype(int))
    return [presses[k] for k in chosen]


def _pressed(touch: Contact) -> FittedPress:
    until = int(np.flatnonzero(touch.depth >= 0.95 * touch.depth.max())[-1]) + 1  # without the retreat
    chosen = np.unique(np.linspace(0, until - 1, LIMITS.readings).round().astype(int))
    chosen = chosen[touch.depth[chosen] > 0]
    if touch.time is None:
        time = np.asarray(LIMITS.probe_step_s * np.arange(1, len(chosen) + 1), dtype=np.float64)
    else:
        time = touch.time[chosen] - touch.time[0]
        chosen, time = chosen[time > 0], time[time > 0]
    return FittedPress(touch.position.mean(axis=0), time, touch.depth[chosen], touch.force[chosen], touch.time is not None)


def _slid(sample: ForceSample, radius: float) -> FittedPress:
    footprint = sqrt(2 * radius * sample.depth)
    share = np.arange(1, LIMITS.slide_steps + 1) / LIMITS.slide_steps
    force = np.where(share == 1, sample.force, np.nan)
    speed = max(float(np.linalg.norm(sample.velocity)), footprint)  # a sample at rest lasts a second
    return FittedPress(sample.position, share * footprint / speed, sample.depth * (1 - (1 - share) ** 2), force, True)


def simulated(
    model: PhantomModel,
    stiffness: Stiffness,
    presses: Sequence[FittedPress],
    at: tuple[Array, Array],
    radius: float,
    deeper: float = 0.0,
) -> list[Array]:
    """Return the forces [N] of the presses with a sphere of `radius` [m], shape (n,) each.

    `at`: points of the wall and outward unit normals there, shapes (k, 3). The depths are `deeper` [m] than recorded:
    the recording did not notice the first part of the contact.
    """
    prony = prony_table(stiffness)
    courses = [
        Course(radius, press.time, depth, contracted(model.voluntary, press.time, depth), prony)
        for press in presses
        for depth in (press.depth + deeper,)
    ]
    return press_forces(model, stiffness, *at, courses)


def amplitude(measured: Array, expected: Array) -> float:
    """Return the factor on the expected forces that fits the measured ones best, shapes (n,)."""
    there = np.isfinite(measured)
    square = float(expected[there] @ expected[there])
    return float(measured[there] @ expected[there]) / square if square > 0 else 0.0
