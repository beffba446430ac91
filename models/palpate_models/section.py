"""What all sections of a scenario have in common: frozen, validated, no unknown fields; and the quantities they are made of."""

from __future__ import annotations

from typing import Annotated, Final

from pydantic import BaseModel, ConfigDict, Field

Positive = Annotated[float, Field(gt=0)]
NonNegative = Annotated[float, Field(ge=0)]
Length = Annotated[float, Field(gt=0, le=1)]
"""[m], of something about a patient: millimetres are refused."""
Force = Annotated[float, Field(gt=0, le=100)]
"""[N]."""
UNITS: Final = {
    "m": "metres",
    "mm": "millimetres",
    "n": "newtons",
    "rad": "radians",
    "deg": "degrees",
    "s": "seconds",
    "mps": "metres a second",
    "kg": "kilograms",
    "px": "pixels",
}
"""What the last part of a field's name says of its unit."""
Vec2 = tuple[float, float]
Vec3 = tuple[float, float, float]


class Section(BaseModel):
    """A part of a scenario."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True, allow_inf_nan=False)


class Pose(Section):
    """A pose as translation and roll-pitch-yaw (fixed axes x, y, z)."""

    xyz_m: Vec3 = (0.0, 0.0, 0.0)
    rpy_rad: Vec3 = (0.0, 0.0, 0.0)


def quadrant(x: float, y: float) -> str:
    """The quadrant of a point of A [m]: RUQ, LUQ, RLQ or LLQ. The patient's right is x < 0, lower is y < 0."""
    return ("R" if x < 0 else "L") + ("L" if y < 0 else "U") + "Q"
