"""Samples as observations of one field: the logarithm of the force that a press to the common depth would feel."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.spatial import ConvexHull, cKDTree

from palpate_assessment.sampling import ForceSample
from palpate_assessment.standard import PressStandard
from palpate_models.numerics.frames import Array, Indices, Mask


class Usable(NamedTuple):
    """Samples that are used."""

    depth: float = 0.2
    """Minimum depth, as a share of the nominal one."""
    force: float = 0.02
    """Minimum force, as a share of the usual one."""
    limited_depth: float = 0.6
    """Minimum depth of a force-limited sample, as a share of the nominal one: at 6 of 10 mm the exponent of the conversion
    adds 6 % to its error. Chosen on `clean`, seeds 1000 to 1019; shallower limits are mostly bone."""
    min_samples: int = 10
    """Minimum number of samples."""
    neighbours: int = 9
    """Presses, itself among them, whose median is the usual force at a place."""
    slide_mps: float = 0.003
    """A sample slides from this speed on; a slower one is a press."""
    wake_m: float = 0.02
    """Distance from a held press within which samples of the slide that follows are left out: the tissue there has relaxed."""


USABLE = Usable()


@dataclass(frozen=True)
class Observations:
    """y = z(x) + errors at m samples, z being the logarithm of apparent stiffness [N]."""

    standard: PressStandard
    xy: Array
    """Place of each sample [m], shape (m, 2), in A: ahead of the indenter's middle by `lead_s` of its travel."""
    time: Array
    """[s]"""
    stroke: Indices
    y: Array
    """log F - n log(depth / press depth), less the usual conversion of slides or held presses, shape (m,)."""
    slid: Mask
    """True for samples of slides, which share this patient's own conversion; presses are felt as they are."""
    rate: Array
    """Log of a slide's speed over the median one, shape (m,); 0 for presses."""
    touched_for: Array
    """Time since the stroke touched [s]."""
    log_depth: Array
    """log(depth / press depth), by which an error of the exponent n counts."""
    per_metre: Array
    """|d y / d depth| = n / depth [1/m], by which an error of the depth counts. Without an anatomy the depth is the stroke's:
    else noise of each depth is evidence for an error that all depths share, and moves the level."""
    per_newton: Array
    """1 / F [1/N], by which an error of the force's zero counts: F is the median force of the stroke, or of a press and
    its neighbours, since a sample's own force must not explain itself."""
    noise: Array
    """Standard deviation of the force's white noise, over the force [1]."""
    depth_uncertainty: Array
    """SD of the depth, as reported [m], shape (m,)."""
    exponent: Array
    """n of F ~ depth^n in the descent to a held press, shape (m,); 0 for other samples."""
    yielded: Mask
    """True if the force limit was met at a depth too small to estimate the force of a full press."""

    @cached_property
    def same_stroke(self) -> Mask:
        """True where two samples are of one stroke, shape (m, m)."""
        return np.asarray(self.stroke[:, None] == self.stroke)

    @cached_property
    def hull(self) -> ConvexHull:
        """Convex hull of the samples; its volume is the area [m^2]."""
        return ConvexHull(self.xy)

    @cached_property
    def width(self) -> float:
        """Minimum width of the convex hull [m]."""
        sides = self.hull.equations
        return float(-(self.xy[self.hull.vertices] @ sides[:, :2].T + sides[:, 2]).min(axis=0).max())

    def part(self, chosen: Indices | slice) -> Observations:
        """Return some of the samples."""
        return replace(self, **{f.name: getattr(self, f.name)[chosen] for f in fields(self) if f.name != "standard"})


def _slides(sample: ForceSample) -> bool:
    return float(np.linalg.norm(sample.velocity)) > USABLE.slide_mps


def keep_firm(samples: Sequence[ForceSample], standard: PressStandard) -> list[ForceSample]:
    """Return the samples that are deep and strong enough, those next to held presses included."""
    shallowest, weakest = USABLE.depth * standard.depth_m, USABLE.force * standard.force_n
    return [s for s in samples if s.depth >= shallowest and s.force >= weakest]


def distance_to_samples(places: Array, samples: Sequence[ForceSample], standard: PressStandard) -> Array:
    """Return the distance of places [m], shape (k, 2), from the nearest firm sample, shape (k,).

    What lies between a held press and its slide is interpolated, and counts as felt.
    """
    return np.asarray(cKDTree(np.array([s.position[:2] for s in keep_firm(samples, standard)])).query(places)[0])


def observe(samples: Sequence[ForceSample], standard: PressStandard) -> Observations | None:
    """Return the usable samples; None if they are too few."""
    pressed = {} if standard.anatomy is None else {s.stroke: s.position for s in samples if not _slides(s)}
    good = [
        s
        for s in keep_firm(samples, standard)
        if not (
            s.stroke in pressed
            and _slides(s)
            and not s.force_limited
            and np.linalg.norm(s.position - pressed[s.stroke]) < USABLE.wake_m
        )
    ]
    calibration = standard.calibration
    if len(good) < USABLE.min_samples:
        return None
    position, velocity = np.array([s.position for s in good]), np.array([s.velocity for s in good])
    depth, force = np.array([s.depth for s in good]), np.array([s.force for s in good])
    log_depth, stroke = np.log(depth / standard.depth_m), np.array([s.stroke for s in good])
    speed = np.linalg.norm(velocity, axis=1)
    slid = (speed > USABLE.slide_mps) & (standard.anatomy is not None)
    xy = (position + calibration.lead_s * velocity)[:, :2]
    numbers, which = np.unique(stroke, return_inverse=True)
    usual, usual_depth = (np.array([np.median(of[stroke == k]) for k in numbers])[which] for of in (force, depth))
    if standard.anatomy is None:  # each press is a stroke
        usual = np.median(force[cKDTree(xy).query(xy, USABLE.neighbours)[1]], axis=1)
    return Observations(
        standard=standard,
        xy=xy,
        time=np.array([s.time for s in good]),
        stroke=stroke,
        y=np.log(force) - calibration.exponent * log_depth - np.where(slid, calibration.conversion, calibration.held),
        slid=slid,
        rate=np.where(slid, np.log(np.maximum(speed, USABLE.slide_mps) / (np.median(speed[slid]) if slid.any() else 1.0)), 0.0),
        touched_for=np.array([s.time_in_contact for s in good]),
        log_depth=log_depth,
        per_metre=calibration.exponent / (usual_depth if standard.anatomy is None else depth),
        per_newton=1.0 / usual,
        noise=np.array([s.force_noise for s in good]) / force,
        depth_uncertainty=np.array([s.depth_uncertainty for s in good]),
        exponent=np.array([s.exponent for s in good]),
        yielded=np.array([s.force_limited for s in good]) & (depth < USABLE.limited_depth * standard.depth_m),
    )
