"""What is under a person's skin: fat, muscles and bones, and how the wall varies from place to place.

Marks of certainty: [V] read in the source, [C] computed from data, [M] from memory, [A] assumed.
"""

from __future__ import annotations

from typing import Annotated, Self

from pydantic import Field, model_validator

from palpate_models.section import Length, NonNegative, Positive, Section, Vec2

Factor = Annotated[float, Field(ge=0.2, le=5)]
Correlation = Annotated[float, Field(ge=-1, le=1)]


class Skeleton(Section):
    """The bones that border the belly: they shape the skin, and the wall over them hardly yields."""

    costal_arch_m: Annotated[float, Field(ge=0.08, le=0.4)] = 0.205
    """Height of the costal arch above the umbilicus on the midline ..."""
    costal_slope: Annotated[float, Field(ge=0.1, le=2)] = 0.55
    """... and how far it descends a metre off the midline."""
    iliac_crest_m: Vec2 = (0.14, -0.175)
    """The left iliac spine; the right one is its mirror image."""
    iliac_radius_m: Length = 0.025
    """Standard deviation of the rise that it makes."""


class Muscles(Section):
    """The two rectus bands and the linea alba between them [widths M, factors A]."""

    linea_alba_m: Length = 0.018
    """Width of the linea alba."""
    rectus_m: Length = 0.065
    """Width of each rectus band."""
    linea_alba: Factor = 1.0
    """Stiffness of the wall on the linea alba over that at the sides ..."""
    rectus: Factor = 1.0
    """... and on the rectus bands."""


class Variation(Section):
    """How a healthy wall differs from place to place, beside its muscles and bones."""

    stiffness: NonNegative = 0.2
    """Standard deviation of the logarithm of the foundation modulus between places over the belly, muscles included [C]."""
    stiffening_per_m: NonNegative = 30.0
    """That of the stiffening itself [C]."""
    correlation: Correlation = 0.0
    """Correlation of the two [C]."""
    length_m: tuple[Length, Length] = (0.010, 0.150)
    """Shortest and longest length over which the wall varies [A]."""

    @model_validator(mode="after")
    def _order(self) -> Self:
        if self.length_m[0] > self.length_m[1]:
            raise ValueError(f"length_m = {self.length_m}: want the shorter length first")
        return self


class Anatomy(Section):
    """A person's body beyond size, wall and lumps."""

    fat_m: Annotated[float, Field(ge=0.001, le=0.1)] = 0.012
    """Thickness of the fat under the skin; what it does to the wall is already in `phantom.stiffness`."""
    dome_m: Annotated[float, Field(ge=-0.03, le=0.08)] = 0.014
    """Fall of the crown line from the umbilicus to both ends of the belly; negative where a slim belly sinks in."""
    exponent: Annotated[float, Field(ge=1.8, le=4)] = 2.4
    """Exponent of the cross section's superellipse: 2 is an ellipse, more is flatter in front."""
    skeleton: Skeleton = Skeleton()
    muscles: Muscles = Muscles()
    variation: Variation = Variation()
    bone: Positive = 2.0
    """Stiffness of the wall over bone, over that beside it [A] ..."""
    bone_stiffening_per_m: Positive = 600.0
    """... and its stiffening: 16 times the modulus from 6.5 mm on [A]."""
