"""Base of all scenario sections (frozen, validated, no unknown fields) and their quantities."""

from typing import Annotated, Final

from pydantic import BaseModel, ConfigDict, Field

Positive = Annotated[float, Field(gt=0)]
NonNegative = Annotated[float, Field(ge=0)]
Length = Annotated[float, Field(gt=0, le=1)]
"""Length [m] on the patient; the limit rejects values in millimetres."""
Force = Annotated[float, Field(gt=0, le=100)]
"""Force [N]."""
UNITS: Final = {
    "m": "metres",
    "mm": "millimetres",
    "n": "newtons",
    "rad": "radians",
    "deg": "degrees",
    "s": "seconds",
    "mps": "metres per second",
    "kg": "kilograms",
    "px": "pixels",
}
"""Units by the last part of a field's name."""
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
    """Return the quadrant of a point in A [m]: RUQ, LUQ, RLQ or LLQ. The patient's right is x < 0, lower is y < 0."""
    return ("R" if x < 0 else "L") + ("L" if y < 0 else "U") + "Q"
