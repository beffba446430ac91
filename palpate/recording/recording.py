"""A recording of palpation as contacts with a body, whoever made it."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from functools import cached_property
from math import sqrt
from typing import Final

import numpy as np

from palpate.recording.faults import Fault
from palpate_assessment.sampling import ContactState, ForceSample, Sampler
from palpate_models.numerics.frames import Array

PROBES_APART_S: Final = 10.0
"""Time given between probes without time: their errors of one moment are unrelated."""
LOADING_SHARE: Final = 0.5
"""Readings from this share of the depth on are fitted by a line, whose end is the force at the depth."""


class ContactKind(StrEnum):
    """Motions of the tool in contact."""

    PROBE = "probe"
    """In and out at one place, without time."""
    PRESS = "press"
    """In and out at one place, over time."""
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


@dataclass(frozen=True, eq=False)
class Recording:
    """Contacts of one body."""

    name: str
    indenter_radius_m: float
    touches: tuple[Contact, ...]
    surface: Array
    """Points of the unpressed skin [m], shape (n, 3), in A."""
    normals: Array
    """Outward unit normals there, shape (n, 3)."""
    X_WA: Array = field(default_factory=lambda: np.eye(4))
    """Pose of A in the frame of the recording's positions, shape (4, 4)."""
    faults: tuple[Fault, ...] = ()
    abdomen: bool = False
    """True if the body is an abdomen and A is at its umbilicus; else no anatomy is assumed."""

    @cached_property
    def depth_m(self) -> float:
        """Nominal depth: the median of the contacts' greatest [m]."""
        return float(np.median([touch.depth.max() for touch in self.touches]))

    def samples(self, depth_m: float | None = None) -> list[ForceSample]:
        """Return the forces at a depth [m], by default the nominal one: one per press or probe, one per footprint of a slide.

        A contact that does not reach the depth gives its force at the depth that it reaches.
        """
        nominal = self.depth_m if depth_m is None else depth_m
        samples: list[ForceSample] = []
        for number, touch in enumerate(self.touches, start=1):
            if touch.kind is ContactKind.SLIDE:
                samples += _slid(touch, number, sqrt(self.indenter_radius_m * nominal))
            elif touch.depth.max() > 0:
                samples.append(_pressed(touch, number, nominal))
        return samples


def _pressed(touch: Contact, number: int, nominal: float) -> ForceSample:
    """Return the force of a press or probe at a depth [m], or at its greatest if that is smaller."""
    depth = min(nominal, float(touch.depth.max()))
    near = np.flatnonzero((touch.depth >= LOADING_SHARE * depth) & (touch.depth <= 1.1 * depth))
    design = np.column_stack((np.ones(len(near)), touch.depth[near] - depth))
    fitted = np.linalg.pinv(design)
    last = near[-1]
    seconds = np.full(len(touch.depth), PROBES_APART_S * number) if touch.time is None else touch.time
    return ForceSample(
        time=float(seconds[last]),
        position=touch.position[near].mean(axis=0),
        normal=touch.normal[last],
        velocity=np.zeros(3),
        depth=depth,
        force=float(fitted[0] @ touch.force[near]),
        force_noise=touch.force_noise * float(np.linalg.norm(fitted[0])),
        time_in_contact=float(seconds[last] - seconds[0]),
        force_limited=False,
        stroke=number,
        depth_uncertainty=touch.depth_uncertainty,
    )


def _slid(touch: Contact, number: int, travel: float) -> list[ForceSample]:
    """Return means of a slide over `travel` [m], as the assessment makes them of an examination."""
    assert touch.time is not None
    sampler = Sampler(travel)
    rows = zip(touch.time.tolist(), touch.position, touch.normal, touch.depth.tolist(), touch.force.tolist(), strict=True)
    states = [ContactState(*row, True, True, stroke=number, depth_uncertainty=touch.depth_uncertainty) for row in rows]
    return [sample for state in states if (sample := sampler.add(state)) is not None]
