"""What persons are drawn with, beside their own bodies: lumps within given ranges, and guarding."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from palpate_models.patient.anatomy import Anatomy
from palpate_models.patient.breathing import Breathing
from palpate_models.patient.guarding import Guarding
from palpate_models.patient.motion import Motion
from palpate_models.patient.wall import MEDIAN
from palpate_models.section import Length, NonNegative, Positive, Section, Vec2

Range = tuple[float, float]
MOST_LUMPS = 8


class Build(StrEnum):
    """How a person is built; `drawn` is one of the others."""

    SLIM = "slim"
    MEDIAN = "median"
    OBESE = "obese"
    DRAWN = "drawn"


class Draw(Section):
    """Lumps and guarding of a population. Every range is (least, most)."""

    lumps: tuple[Annotated[int, Field(ge=0, le=MOST_LUMPS)], Annotated[int, Field(ge=0, le=MOST_LUMPS)]] = (0, 0)
    """How many lumps, pairs counted as two."""
    radius_m: Range = (0.005, 0.040)
    """The smaller half axis, evenly drawn by its logarithm."""
    elongation: Range = (1.0, 1.5)
    """The longer half axis over the smaller; a ridge has 3 or more."""
    depth_m: Range = (0.0, 0.040)
    """How far below the skin a lump begins, evenly drawn."""
    contrast: Range = (2.0, 10.0)
    """Evenly drawn by its logarithm; on one side of 1."""
    pairs: Annotated[float, Field(ge=0, le=1)] = 0.0
    """How probably a lump is followed by another close to it."""
    place: Literal["inside", "edge"] = "inside"
    """`edge`: centres lie on the border of the region."""
    region_m: tuple[Length, Length] = (0.20, 0.20)
    """Width and height of the region about the umbilicus in which the centres lie."""
    guarding: Literal["none", "voluntary", "involuntary"] = "none"
    """Whether a muscle is contracted, with a ratio that was measured on living people."""

    @model_validator(mode="after")
    def _ranges(self) -> Self:
        within = {
            "lumps": (0, MOST_LUMPS),
            "radius_m": (0.005, 0.04),
            "elongation": (1, 6),
            "depth_m": (0, 0.04),
            "contrast": (0.1, 20),
        }
        for name, (lowest, highest) in within.items():
            low, high = getattr(self, name)
            if not lowest <= low <= high <= highest:
                raise ValueError(f"{name} = {low:g} to {high:g}: want {lowest:g} <= least <= most <= {highest:g}")
        if self.contrast[0] <= 1 <= self.contrast[1]:
            raise ValueError(f"contrast = {self.contrast[0]:g} to {self.contrast[1]:g}: want both above 1, or both below")
        return self


class Lesion(Section):
    """A lump: stiffer or softer than its surroundings, of elliptic outline in the abdomen's xy plane."""

    centre_m: Vec2
    """Centre, x to the patient's left and y to the head, from the umbilicus."""
    radii_m: tuple[Length, Length] = (0.03, 0.03)
    """Half axes of the half-contrast outline."""
    contrast: Annotated[float, Field(ge=0.1, le=20)] = 4.0
    """Stiffness at its centre over the stiffness without it; below 1 it is softer than its surroundings. Not 1."""
    edge_m: Positive = 0.008
    """Width of the smooth edge."""
    depth_m: Annotated[float, Field(ge=0, le=0.15)] | None = None
    """How far below the skin it begins: an ellipsoid whose vertical half axis is the smaller of `radii_m`. The surface tier has
    the factor that this ellipsoid gives to the skin (`palpate_models.patient.field`). None: it reaches from the skin inward."""

    @model_validator(mode="after")
    def _contrast(self) -> Self:
        if self.contrast == 1:
            raise ValueError("contrast = 1 is no lump; want 0.1 to 20 and not 1")
        return self


class Background(Section):
    """Natural variation of a healthy abdomen's stiffness: log-normal, with a Gaussian correlation."""

    cv: Annotated[float, Field(ge=0, le=0.6)] = 0.2
    """Coefficient of variation."""
    correlation_m: Annotated[float, Field(ge=0.01, le=0.5)] = 0.05
    """Correlation length."""
    margins: Annotated[float, Field(ge=1, le=4)] = 1.5
    """How much stiffer the wall is at the costal margin and at the pelvis."""


class Stiffness(Section):
    """Mechanics of the healthy wall: that of the median person (`patient.wall`), with Prony weights after liver."""

    k_w_n_per_m3: Annotated[float, Field(ge=1e3, le=1e8)] = MEDIAN.k_w_n_per_m3
    """Instantaneous Winkler foundation modulus."""
    length_m: Annotated[float, Field(ge=0.002, le=0.1)] = MEDIAN.length_m
    """Pasternak length l = sqrt(G / k_w)."""
    stiffening_per_m: NonNegative = MEDIAN.stiffening_per_m
    """How fast the modulus rises with depth: at a displacement u it is k_w (1 + (stiffening_per_m u)^2), see `wall.py`."""
    prony_g: tuple[NonNegative, ...] = (0.3, 0.2)
    """Relaxing fractions of the instantaneous modulus."""
    prony_tau_s: tuple[Positive, ...] = (1.86, 51.3)
    """Their time constants."""
    dashpot_s: Annotated[float, Field(gt=0, le=1)] = 0.05
    """Dashpot over foundation modulus, C = dashpot_s * k_w."""
    friction: Annotated[float, Field(ge=0, le=2)] = 0.3
    """Coulomb friction between indenter and skin."""

    @model_validator(mode="after")
    def _prony(self) -> Self:
        if len(self.prony_g) != len(self.prony_tau_s):
            raise ValueError("prony_g and prony_tau_s need as many entries as each other")
        if sum(self.prony_g) >= 1:
            raise ValueError(f"prony_g must sum to less than 1, not {sum(self.prony_g)}")
        return self


class Phantom(Section):
    """The abdomen. Reaches only tissue and scoring."""

    kind: Literal["parametric", "person", "mesh"] = "parametric"
    """`person`: size, wall and anatomy are drawn from the scenario's seed as living people vary (`patient.person`)."""
    build: Build = Build.DRAWN
    """How a person is built (kind: person)."""
    draw: Draw = Draw()
    """Lumps and guarding that are drawn, beside those of `lesions` and `guarding` (kind: person)."""
    anatomy: Anatomy | None = None
    """What was drawn (kind: person). With it the phantom is whole, and nothing is drawn any more."""
    mesh: str | None = None
    """OBJ, STL or PLY file in metres, in the abdomen frame (kind: mesh)."""
    size_m: tuple[Length, Length, Length] = (0.36, 0.46, 0.20)
    """Width, length and height of the parametric abdomen."""
    edge_m: Annotated[float, Field(ge=0.0025, le=0.02)] = 0.005
    """Longest mesh edge in the examined region."""
    stiffness: Stiffness = Stiffness()
    background: Background = Background()
    lesions: tuple[Lesion, ...] = ()
    """Lumps, stiffer or softer than their surroundings."""
    guarding: tuple[Guarding, ...] = ()
    """Contracted muscles: wide and smooth."""
    breathing: Breathing = Breathing()
    motion: Motion = Motion()

    @model_validator(mode="after")
    def _guarding(self) -> Self:
        if len({area.kind for area in self.guarding}) > 1:
            raise ValueError("guarding: all areas of a patient are of one kind, voluntary or involuntary")
        return self

    @model_validator(mode="after")
    def _mesh(self) -> Self:
        if (self.kind == "mesh") != (self.mesh is not None):
            raise ValueError("kind: mesh needs mesh: FILE, and mesh: FILE needs kind: mesh")
        return self

    @model_validator(mode="after")
    def _person(self) -> Self:
        usual = {name: field.default for name, field in Phantom.model_fields.items()}
        if self.kind != "person":
            set_here = [name for name in ("build", "draw", "anatomy") if getattr(self, name) != usual[name]]
            if set_here:
                raise ValueError(f"{set_here[0]} belongs to kind: person, not to kind: {self.kind}")
        elif self.anatomy is None:
            if self.guarding and self.draw.guarding != "none":
                raise ValueError("draw.guarding is for a person without guarding: leave one of them out")
            for name in ("size_m", "stiffness", "background"):
                if getattr(self, name) != usual[name]:
                    raise ValueError(f"{name} of kind: person is drawn from the seed: leave it out")
        return self
