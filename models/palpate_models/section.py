"""Base of all scenario sections (frozen, validated, no unknown fields) and their quantities."""

from collections.abc import Collection
from difflib import get_close_matches
from pathlib import Path
from typing import Annotated, Any, Final, TypeVar

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError

from palpate_errors import UserError
from palpate_inputs import read_yaml

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
_T = TypeVar("_T")


def _check_order(ends: tuple[Any, Any]) -> tuple[Any, Any]:
    if ends[0] > ends[1]:
        raise ValueError("expected the smaller value first")
    return ends


Ends = Annotated[tuple[_T, _T], AfterValidator(_check_order)]
"""Minimum and maximum of a range."""
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


_M = TypeVar("_M", bound=BaseModel)


def read_model(path: Path, model: type[_M], error: type[UserError] = UserError) -> _M:
    """Return the model in a YAML file. Raises `error` that names the file and each wrong field with what is allowed."""
    try:
        return model.model_validate(read_yaml(path, error))
    except OSError as problem:
        raise error(f"{path}: {problem}") from problem
    except ValidationError as problem:
        wrong = [
            (e["loc"], unknown_field(str(e["loc"][-1]), model) if e["type"] == "extra_forbidden" else e["msg"])
            for e in problem.errors()
        ]
        text = "; ".join(f"{'.'.join(map(str, field)) or 'the file'}: {what}" for field, what in wrong)
        raise error(f"{path}: {text}") from problem


def did_you_mean(word: str, known: Collection[str]) -> str:
    """Return the most similar known word as a sentence; empty if there is none."""
    near = get_close_matches(word, known, n=1)
    return f". Did you mean {near[0]}?" if near else ""


def unknown_field(field: str, model: type[BaseModel]) -> str:
    """Return the message for a field that neither the model nor a nested one has, with the most similar field."""
    schema = model.model_json_schema()
    parts = (schema, *schema.get("$defs", {}).values())
    return f"unknown field{did_you_mean(field, {name for part in parts for name in part.get('properties', ())})}"
