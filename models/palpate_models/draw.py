"""What persons are drawn with, beside their own bodies: lumps within given ranges, and guarding."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from palpate_models.section import Length, Section

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
