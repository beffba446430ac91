"""The standard press and the priors of a stiffness map, the skin through its samples, the fitted constants, and the samples as
observations of one field: the logarithm of the force that a press to the common depth would feel.

A press averages over the radius of its footprint, sqrt(2 R d - d^2) for a sphere of radius R at depth d, so all lengths scale
with it. Forces scale with the force of the press. `calibration.yaml` is made by `python -m research.assessment_calibration`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cache, cached_property
from importlib.resources import files
from math import sqrt
from typing import Any, Final, NamedTuple, Self

import numpy as np
import yaml
from pydantic import BaseModel, ConfigDict
from scipy.interpolate import LinearNDInterpolator
from scipy.spatial import ConvexHull, Delaunay, cKDTree
from scipy.special import expit

from palpate_assessment.sampling import ForceSample
from palpate_models.numerics.frames import Array, Indices, Mask
from palpate_models.scenario import press

_GAP: Final = 2.0
"""Maximum circumradius of a triangle of samples without a gap, over their usual distance."""

_NEIGHBOURS: Final = 9
"""Samples, itself among them, whose median is the height of the skin at a place."""


@dataclass(frozen=True)
class SampledPlaces:
    """Places of samples; m of them, not all on one line."""

    xy: Array
    """[m], shape (m, 2)."""
    z: Array
    """Height of the skin there [m], shape (m,)."""

    @cached_property
    def mesh(self) -> Delaunay:
        """Triangles between the places."""
        return Delaunay(self.xy)

    @cached_property
    def circumradii(self) -> Array:
        """Circumradii of the triangles [m], shape (t,)."""
        sides = [self.xy[self.mesh.simplices[:, k]] - self.xy[self.mesh.simplices[:, k - 1]] for k in range(3)]
        doubled = np.abs(np.linalg.det(np.stack(sides[:2], axis=1)))
        return np.asarray(np.prod([np.linalg.norm(side, axis=1) for side in sides], axis=0) / np.maximum(2 * doubled, 1e-30))

    @cached_property
    def spacing(self) -> float:
        """Usual distance of neighbours [m]: in a raster its pitch, in lines about that of one from the next."""
        whole = (self.mesh.neighbors >= 0).all(axis=1)  # those along the border may be slivers
        return float(np.sqrt(2) * np.median(self.circumradii[whole if whole.any() else slice(None)]))

    @cached_property
    def filled(self) -> Mask:
        """True for triangles without a gap of many samples, as in a notch of the region, shape (t,)."""
        return np.asarray(self.circumradii <= _GAP * self.spacing)

    def encloses(self, places: Array) -> Mask:
        """Return True for places [m] between samples, shape (k, 2) -> (k,)."""
        inside = self.mesh.find_simplex(places)
        return np.asarray((inside >= 0) & self.filled[inside])

    def lift(self, places: Array) -> Array:
        """Return places [m] on the skin through the samples, shape (k, 2) -> (k, 3); outside it is as high as the nearest one."""
        height = np.asarray(self._height(places))
        outside = np.isnan(height)
        height[outside] = self.z[cKDTree(self.xy).query(places[outside])[1]]
        return np.column_stack((places, height))

    @cached_property
    def _height(self) -> LinearNDInterpolator:
        return LinearNDInterpolator(self.mesh, self.z)


def places_of(samples: Sequence[ForceSample]) -> SampledPlaces:
    """Return the places of samples; each is as high as its neighbours, for an error of its own depth is not the body's shape."""
    position = np.array([sample.position for sample in samples])
    near = cKDTree(position[:, :2]).query(position[:, :2], min(_NEIGHBOURS, len(position)))[1].reshape(len(position), -1)
    return SampledPlaces(position[:, :2], np.median(position[near, 2], axis=1))


class Calibration(BaseModel):
    """Constants of the regression, and of a candidate's probability."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    exponent: float
    """n of F ~ depth^n around the examination's depth."""
    exponent_sd: float
    """Its SD between people."""
    conversion: float
    """Log of the ratio of sliding force at the depth of the press to the force of the press."""
    conversion_sd: float
    """Its SD between people, tissues, speeds and indenters; presses held before slides determine the patient's own."""
    held: float
    """Log of the ratio of held presses to the standard press, against the slides near them: beyond their wake, too, slides are
    a little weaker than elsewhere."""
    lead_s: float
    """A sliding indenter feels this much of its travel ahead [s]."""
    probability: tuple[float, ...]
    """Weights of a candidate's features (`detection.FEATURES`) in the logit of its probability, the constant first."""
    guarding: tuple[float, float, float]
    """Weights of the signs of a tensed muscle (`guarding.Signs`) in its log odds against everything except a lump, the constant
    first."""
    ridge: tuple[float, float, float, float]
    """Weights of the evidence for a ridge (`Candidate.structures`) in its log odds against a lump, the constant first."""
    bone: tuple[float, float, float, float, float]
    """Weights of the evidence for bone in its log odds against a lump, the constant first."""
    soft: tuple[float, float, float, float]
    """Weights of the evidence for a soft defect in its log odds against a lump, the constant first."""
    prevalence: float
    """Share of the patients of the fit who have a lump that can be felt."""
    tail: tuple[float, float]
    """Location and scale of a healthy examination's maximum logit: P(max > s) = exp(-(s - location) / scale)."""

    def logit(self, features: Array) -> Array:
        """Logits of the probability of candidates with `features`, shape (k, f) -> (k,)."""
        return np.asarray(self.probability[0] + features @ np.array(self.probability[1:]))

    def muscle(self, features: Array) -> Array:
        """The logarithm of how much more probable a tensed muscle is than nothing, of signs' `features`, shape (k, 2) -> (k,)."""
        return np.asarray(self.guarding[0] + features @ np.array(self.guarding[1:]))

    def structures(self, evidence: Array) -> Array:
        """Logs of how much more probable a ridge, bone and a soft defect are than a lump, of `evidence` (k, 10) -> (k, 3)."""
        parts = ((self.ridge, evidence[:, :3]), (self.bone, evidence[:, 3:7]), (self.soft, evidence[:, 7:]))
        return np.column_stack([weights[0] + of @ np.array(weights[1:]) for weights, of in parts])

    def threshold(self, false_findings: float) -> float:
        """Return the logit that a healthy examination exceeds with the probability `false_findings`."""
        location, scale = self.tail
        return float(location - scale * np.log(false_findings))


@cache
def load_calibration() -> Calibration:
    """Return the calibration of this version."""
    return Calibration.model_validate(yaml.safe_load(files(__package__).joinpath("calibration.yaml").read_text("utf-8")))


class AnatomyPrior(NamedTuple):
    """Prior of ribs, iliac crests and muscles of an abdomen, in A."""

    arch_m: float = 0.17
    """Height of the costal arch above the umbilicus, on the midline."""
    arch_slope: float = 1.0
    """Its descent per metre off the midline: an infrasternal angle of 90 degrees."""
    arch_width_m: float = 0.028
    """Scale of the logistic distribution of its place: SD 50 mm, of which 20 mm are of the registered umbilicus."""
    iliac_m: tuple[float, float] = (0.12, -0.09)
    """Position of the iliac spines: half their usual distance of 24 cm lateral, and above the umbilicus."""
    iliac_width_m: float = 0.045
    """SD of the bone's place around them."""
    bone_m: float = 0.022
    """Length over which bone changes the force."""
    strip_m: tuple[float, float] = (0.018, 0.08)
    """Lengths of muscles and linea alba, across and along the body."""

    def bone(self, xy: Array) -> Array:
        """Return the prior of ribs or iliac crests under places of the abdomen [m], shape (k, 2) -> (k,)."""
        lateral, up = np.abs(xy[:, 0]), xy[:, 1]
        ribs = expit((up - self.arch_m + self.arch_slope * lateral) / self.arch_width_m)
        spine = np.exp(-0.5 * ((lateral - self.iliac_m[0]) ** 2 + (up - self.iliac_m[1]) ** 2) / self.iliac_width_m**2)
        return np.asarray(np.maximum(ribs, spine))


class Lengths(NamedTuple):
    """Lengths [m] for the footprint of the abdomen's standard press."""

    fields_m: tuple[float, ...] = (0.012, 0.022, 0.045, 0.09, 0.18)
    """Length scales of the fields of natural variation."""
    smooth_m: float = 0.045
    """Fields of this length and more are smooth: alike over a hand's breadth."""
    edge_m: float = 0.007
    """SD of the edge with which a lump at the skin is felt: half the footprint."""
    wide_edge_m: float = 0.016
    """SD of the edge of a lump under tissue that spreads the pressure."""
    free_m: float = 0.012
    """Length over which a lump differs from the ideal shape."""
    radii_m: tuple[float, ...] = (0.008, 0.012, 0.018, 0.026, 0.036)
    """Initial radii of the search for lumps."""
    pitch_m: float = 0.01
    """Distance between their centres, and how far these may be outside the samples."""
    refined_m: float = 0.004
    """First step of the refined centre."""
    piece_m: float = 0.03
    """Length of the pieces in which a stroke is checked: what the indenter feels at one place."""
    node_m: float = 0.005
    """Pitch of the map."""


@dataclass(frozen=True)
class ErrorPrior:
    """Errors of equipment and method."""

    breathing_s: float = 1.0
    """Correlation time of residual breathing."""
    min_depth_m: float = 0.0001
    """Prior median of the depth's errors for strokes that claim to have none."""
    surface_m: float = 0.015
    """Correlation length of the surface error that strokes share (without offset and tilt)."""
    surface_share: float = 0.8
    """Its share of the depth uncertainty. A scan cannot separate it from stiffness."""
    wide_m: float = 0.15
    """Correlation length of the offset and tilt that remain after touches."""
    wide_share: float = 0.7
    """Their share of the depth uncertainty."""
    onset_m: float = 0.00015
    """Error common to all touches: 0.11 mm with typical equipment, RMS over twelve examinations, 0.29 mm with poor, over ten
    (tuning seeds) (computed). The contact model does not fit every wall exactly, and skin that was pressed before is lower."""
    tare: float = 0.012
    """Prior median of the zero of a stroke's force, over the force of the press: 0.06 N with typical equipment, 0.12 N with poor
    (tuning seeds 0 to 9) (computed)."""
    shared_tare: float = 1.0
    """Variance of the zero of the force that all strokes share, over that of a single one (0.08 N with poor equipment)."""
    white_sd: float = 0.01
    """Prior median of the independent error of a sample, over its force."""
    press_sd: float = 0.02
    """SD of the log difference of held presses and the standard press, common to an examination."""
    rate_sd: float = 0.06
    """SD of the exponent with which slides depend on their speed: strokes are slower at their ends."""
    slide_sd: float = 0.015
    """SD of the log difference of slide and press from place to place, besides the common one."""
    lump_press_sd: float = 0.1
    """SD of the difference of press and slide over a lump, as a share of its log-contrast."""


ONSET_REFERENCED_ERRORS = ErrorPrior(
    min_depth_m=0.00003,
    surface_share=0.0,
    wide_share=0.0,
    onset_m=0.0,
    shared_tare=0.0,
    press_sd=0.0,
    rate_sd=0.0,
    slide_sd=0.0,
    lump_press_sd=0.0,
)
"""Errors of presses whose depth counts from their own onset, and which are themselves what the map is of."""
ABDOMEN = AnatomyPrior()
LENGTHS = Lengths()


@dataclass(frozen=True)
class PressStandard:
    """The press that a map is of; by default that of the abdomen's examination."""

    radius_m: float = 0.015
    """Radius of the spherical indenter."""
    depth_m: float = press.DEPTH_M
    """Nominal depth."""
    force_n: float = 5.0
    """Usual force."""
    anatomy: AnatomyPrior | None = ABDOMEN
    """None for a body of which nothing is known: long shapes are tried too, and probabilities are of a stated prior."""
    places: SampledPlaces | None = None
    """Sampled places; None with an anatomy."""
    calibration: Calibration = field(default_factory=load_calibration)
    """Exponent and conversion of the tissue."""
    errors: ErrorPrior = ErrorPrior()

    @classmethod
    def of(cls, samples: Sequence[ForceSample], radius_m: float, exponent: float, exponent_sd: float = 0.0) -> Self:
        """Return the standard of presses of another body: their own depth, force and exponent, and no anatomy."""
        depth_m = float(np.median([sample.depth for sample in samples]))
        force_n = float(np.median([sample.force for sample in samples]))
        none = dict.fromkeys(("conversion", "conversion_sd", "held", "lead_s"), 0.0)
        tissue = {"exponent": exponent, "exponent_sd": exponent_sd, **none}
        calibration = load_calibration().model_copy(update=tissue)
        return cls(radius_m, depth_m, force_n, None, places_of(samples), calibration, ONSET_REFERENCED_ERRORS)

    @property
    def footprint_m(self) -> float:
        """Radius of the contact of a sphere at the nominal depth, at most its own."""
        d = min(self.depth_m, self.radius_m)
        return sqrt(2 * self.radius_m * d - d**2)

    @property
    def tare_n(self) -> float:
        """Prior median of the zero of a stroke's force [N]."""
        return self.errors.tare * self.force_n

    @cached_property
    def lengths(self) -> Lengths:
        """Lengths for this footprint."""
        scale = self.footprint_m / _USUAL_FOOTPRINT_M
        return Lengths(*(_scale(length, scale) for length in LENGTHS))


def _scale(length: Any, scale: float) -> Any:
    """Return a length, or each of several, times a scale."""
    return tuple(one * scale for one in length) if isinstance(length, tuple) else length * scale


USUAL = PressStandard()
"""The press of the abdomen's examination."""
_USUAL_FOOTPRINT_M = USUAL.footprint_m


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
