"""The standard press and the priors of a stiffness map, the skin through its samples, and the fitted constants.

A press averages over the radius of its footprint, sqrt(2 R d - d^2) for a sphere of radius R at depth d, so all lengths scale
with it. Forces scale with the force of the press. `calibration.yaml` is made by `python -m research.assessment_calibration`.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache, cached_property
from importlib.resources import files
from math import sqrt
from typing import Any, Final, NamedTuple, Self

import numpy as np
import yaml
from pydantic import BaseModel, ConfigDict
from scipy.interpolate import LinearNDInterpolator
from scipy.spatial import Delaunay, cKDTree
from scipy.special import expit

from palpate_assessment.sampling import ForceSample
from palpate_models.numerics.frames import Array, Mask
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
