"""Scenario sections of the patient: anatomy, lumps, wall mechanics, breathing and guarding.

Marks of certainty: [V] read in the source, [C] computed from data, [M] from memory, [A] assumed.
"""

from enum import StrEnum
from typing import Annotated, Literal, Self

from pydantic import AfterValidator, Field, model_validator

from palpate_models.patient.motion import Breathing, Motion
from palpate_models.patient.wall import MEDIAN, Guarding
from palpate_models.section import Ends, Length, NonNegative, Positive, Section, Vec2


def _changing(factor: float) -> float:
    if factor == 1:
        raise ValueError("1 changes nothing; expected 0.1 to 20 and not 1")
    return factor


Change = Annotated[float, Field(ge=0.1, le=20), AfterValidator(_changing)]
Factor = Annotated[float, Field(ge=0.2, le=5)]
Correlation = Annotated[float, Field(ge=-1, le=1)]


class Skeleton(Section):
    """Bones around the belly: they shape the skin, and the wall over them is stiff."""

    costal_arch_m: Annotated[float, Field(ge=0.08, le=0.4)] = 0.205
    """Height of the costal arch above the umbilicus on the midline."""
    costal_slope: Annotated[float, Field(ge=0.1, le=2)] = 0.55
    """Descent of the costal arch per distance from the midline [1]."""
    iliac_crest_m: Vec2 = (0.14, -0.175)
    """Position (x, y) of the left iliac spine; the right one is its mirror image."""
    iliac_radius_m: Length = 0.025
    """Standard deviation of the Gaussian rise over the spine."""
    lateral_m: Annotated[float, Field(ge=-0.05, le=0.05)] = 0.0
    """Distance of the skeleton's midline from the umbilicus, to the patient's left."""
    tilt: Annotated[float, Field(ge=-0.4, le=0.4)] = 0.0
    """Slope of the skeleton in the frontal plane: bones are higher by this share of their distance to the left of its midline."""


class Muscles(Section):
    """The two rectus bands and the linea alba between them [widths M, factors A]."""

    linea_alba_m: Length = 0.018
    """Width of the linea alba."""
    rectus_m: Length = 0.065
    """Width of each rectus band."""
    linea_alba: Factor = 1.0
    """Stiffness on the linea alba relative to the sides."""
    rectus: Factor = 1.0
    """Stiffness on the rectus bands relative to the sides."""


class Variation(Section):
    """Natural variation of a healthy wall, besides muscles and bones."""

    stiffness: NonNegative = 0.2
    """Standard deviation of the log foundation modulus over the belly, muscles included [C]."""
    stiffening_per_m: NonNegative = 30.0
    """Standard deviation of the stiffening [C]."""
    correlation: Correlation = 0.0
    """Correlation of log modulus and stiffening [C]."""
    length_m: Ends[Length] = (0.010, 0.150)
    """Shortest and longest correlation length of the variation [A]."""


class Anatomy(Section):
    """Body of a person, besides size, wall and lumps."""

    fat_m: Annotated[float, Field(ge=0.001, le=0.1)] = 0.012
    """Thickness of the fat under the skin. Its effect on the wall is included in `phantom.stiffness`."""
    dome_m: Annotated[float, Field(ge=-0.03, le=0.08)] = 0.014
    """Drop of the midline from the umbilicus to both ends of the belly; negative for a sunken belly."""
    exponent: Annotated[float, Field(ge=1.8, le=4)] = 2.4
    """Exponent of the superelliptic cross section: 2 is an ellipse, larger is flatter in front."""
    skeleton: Skeleton = Skeleton()
    muscles: Muscles = Muscles()
    variation: Variation = Variation()
    bone: Positive = 2.0
    """Stiffness of the wall over bone relative to the wall next to it [A]."""
    bone_stiffening_per_m: Positive = 600.0
    """Stiffening of the wall over bone: 16 times the modulus from 6.5 mm [A]."""


MOST_LUMPS = 8
Count = Annotated[int, Field(ge=0, le=MOST_LUMPS)]


class Build(StrEnum):
    """Builds of a person; `drawn`: one of the others at random."""

    SLIM = "slim"
    MEDIAN = "median"
    OBESE = "obese"
    DRAWN = "drawn"


class Draw(Section):
    """Sampling ranges for lumps and guarding of a person. Every range is (minimum, maximum)."""

    lumps: Ends[Count] = (0, 0)
    """Number of lumps; a pair counts as two."""
    radius_m: Ends[Annotated[float, Field(ge=0.005, le=0.04)]] = (0.005, 0.040)
    """Smaller half axis, log-uniform."""
    elongation: Ends[Annotated[float, Field(ge=1, le=6)]] = (1.0, 1.5)
    """Ratio of the half axes, uniform; a ridge has 3 or more."""
    depth_m: Ends[Annotated[float, Field(ge=0, le=0.04)]] = (0.0, 0.040)
    """Depth of the lump's top below the skin, uniform."""
    contrast: Ends[Annotated[float, Field(ge=0.1, le=20)]] = (2.0, 10.0)
    """Contrast, log-uniform; both limits above 1 or both below."""
    pairs: Annotated[float, Field(ge=0, le=1)] = 0.0
    """Probability that a lump has a second one next to it."""
    place: Literal["inside", "edge"] = "inside"
    """`edge`: centres are on the border of the region."""
    region_m: tuple[Length, Length] = (0.20, 0.20)
    """Width and height of the region of the centres, around the umbilicus."""
    guarding: Literal["none", "voluntary", "involuntary"] = "none"
    """Kind of guarding; its force ratio is drawn from measurements on living people."""

    @model_validator(mode="after")
    def _either(self) -> Self:
        if self.contrast[0] <= 1 <= self.contrast[1]:
            raise ValueError(f"contrast = {self.contrast[0]:g} to {self.contrast[1]:g}: expected both above 1, or both below")
        return self


class Lesion(Section):
    """A lump: stiffer or softer than its surroundings, of elliptic outline in the abdomen's xy plane."""

    centre_m: Vec2
    """Centre, x to the patient's left and y to the head, from the umbilicus."""
    radii_m: tuple[Length, Length] = (0.03, 0.03)
    """Half axes of the half-contrast outline."""
    contrast: Change = 4.0
    """Stiffness at the centre relative to the stiffness without the lump; below 1 it is softer. Not 1."""
    edge_m: Positive = 0.008
    """Width of the smooth edge."""
    depth_m: Annotated[float, Field(ge=0, le=0.15)] | None = None
    """Depth of the lump's top below the skin, for an ellipsoid whose vertical half axis is the smaller of `radii_m`. The surface
    tier uses its equivalent factor at the skin (`palpate_models.patient.field`). None: the lump reaches from the skin inward."""


class StructureKind(StrEnum):
    """Kinds of structures."""

    SCAR = "scar"
    HERNIA = "hernia"
    DIASTASIS = "diastasis"
    MESH = "mesh"
    STOOL = "stool"


class Structure(Section):
    """A part of the wall that is stiffer or softer than its surroundings and not a lump: all points near a polyline."""

    kind: StructureKind
    line_m: Annotated[tuple[Vec2, ...], Field(min_length=1)]
    """Points of the polyline in the abdomen's xy plane, from the umbilicus. One point with `radii_m` is an ellipse."""
    radii_m: tuple[Length, Length] = (0.005, 0.005)
    """Half widths of the half-effect outline about the polyline, along x and along y."""
    factor: Change
    """Stiffness relative to the stiffness without the structure. Not 1."""
    edge_m: Positive = 0.006
    """Width of the smooth edge."""
    depth_m: Annotated[float, Field(ge=0, le=0.15)] | None = None
    """Depth of its top below the skin; every tier takes what the skin shows of it (`palpate_models.patient.field`). None: it goes
    through the wall."""


class Background(Section):
    """Natural variation of a healthy abdomen's stiffness: log-normal, with a Gaussian correlation."""

    cv: Annotated[float, Field(ge=0, le=0.6)] = 0.2
    """Coefficient of variation."""
    correlation_m: Annotated[float, Field(ge=0.01, le=0.5)] = 0.05
    """Correlation length."""
    margins: Annotated[float, Field(ge=1, le=4)] = 1.5
    """Stiffness at the costal margin and the pelvis relative to the middle."""


class Stiffness(Section):
    """Mechanics of the healthy wall. Defaults: the median person (`patient.wall`), with Prony weights of liver."""

    k_w_n_per_m3: Annotated[float, Field(ge=1e3, le=1e8)] = MEDIAN.k_w_n_per_m3
    """Instantaneous Winkler foundation modulus."""
    length_m: Annotated[float, Field(ge=0.002, le=0.1)] = MEDIAN.length_m
    """Pasternak length l = sqrt(G / k_w)."""
    stiffening_per_m: NonNegative = MEDIAN.stiffening_per_m
    """Stiffening beta: at displacement u the modulus is k_w (1 + (beta u)^2), see `wall.py`."""
    prony_g: tuple[NonNegative, ...] = (0.3, 0.2)
    """Relaxing fractions of the instantaneous modulus."""
    prony_tau_s: tuple[Positive, ...] = (1.86, 51.3)
    """Time constants of `prony_g`."""
    dashpot_s: Annotated[float, Field(gt=0, le=1)] = 0.05
    """Dashpot over foundation modulus, C = dashpot_s * k_w."""
    friction: Annotated[float, Field(ge=0, le=2)] = 0.3
    """Coulomb friction between indenter and skin."""

    @model_validator(mode="after")
    def _prony(self) -> Self:
        if len(self.prony_g) != len(self.prony_tau_s):
            raise ValueError("prony_g and prony_tau_s need equal numbers of entries")
        if sum(self.prony_g) >= 1:
            raise ValueError(f"prony_g must sum to less than 1, not {sum(self.prony_g)}")
        return self


class Phantom(Section):
    """The abdomen. Only the tissue and scoring get this section."""

    kind: Literal["parametric", "person", "mesh", "grid"] = "parametric"
    """`parametric`: set below. `person`: size, wall and anatomy are drawn from the seed by the statistics of living people.
    `mesh`: the surface is read from a file. `grid`: surface, modulus and stiffening are read from a file."""
    build: Build = Build.DRAWN
    """Build of the person (kind: person)."""
    draw: Draw = Draw()
    """Random lumps and guarding, in addition to `lesions` and `guarding` (kind: person)."""
    anatomy: Anatomy | None = None
    """The drawn anatomy (kind: person). If it is set, nothing is drawn."""
    mesh: str | None = None
    """OBJ, STL or PLY file in metres, in the abdomen frame (kind: mesh)."""
    grid: str | None = None
    """CSV file of `patient.phantom` (kind: grid), relative to the scenario's file. It replaces `background` and, of
    `stiffness`, `k_w_n_per_m3` and `stiffening_per_m`."""
    size_m: tuple[Length, Length, Length] = (0.36, 0.46, 0.20)
    """Width, length and height of the parametric abdomen; of `kind: grid`, the height is the thickness of the elastic tier."""
    edge_m: Annotated[float, Field(ge=0.001, le=0.02)] = 0.005
    """Longest mesh edge in the examined region."""
    stiffness: Stiffness = Stiffness()
    background: Background = Background()
    lesions: tuple[Lesion, ...] = ()
    """Lumps, stiffer or softer than their surroundings."""
    structures: tuple[Structure, ...] = ()
    """Scars, hernias and other structures of the wall, which are not lumps."""
    guarding: tuple[Guarding, ...] = ()
    """Areas of contracted muscle."""
    breathing: Breathing = Breathing()
    motion: Motion = Motion()

    @model_validator(mode="after")
    def _guarding(self) -> Self:
        if len({area.kind for area in self.guarding}) > 1:
            raise ValueError("guarding: all areas of a patient must be of one kind, voluntary or involuntary")
        return self

    @model_validator(mode="after")
    def _mesh(self) -> Self:
        for kind in ("mesh", "grid"):
            if (self.kind == kind) != (getattr(self, kind) is not None):
                raise ValueError(f"kind: {kind} needs {kind}: FILE, and {kind}: FILE needs kind: {kind}")
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
