"""Base of all scenario sections (frozen, validated, no unknown fields) and their quantities."""

from collections.abc import Collection, Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Annotated, Any, Final, TypeVar

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError

from palpate_errors import UserError
from palpate_inputs import brief, read_yaml

Positive = Annotated[float, Field(gt=0)]
NonNegative = Annotated[float, Field(ge=0)]
Length = Annotated[float, Field(gt=0, le=1)]
"""Length [m] on the patient; the limit rejects values in millimetres."""
Turn = Annotated[float, Field(ge=-6.3, le=6.3)]
"""Angle [rad]; the limit rejects values in degrees."""
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
        wrong = [(brief(item["input"]), *explain_error(item, model)) for item in problem.errors()]
        text = "; ".join(f"{'.'.join(field) or 'the file'} = {value}: {what}" for value, field, what in wrong)
        raise error(f"{path}: {text}") from problem


_NO_SECTION: Final = frozenset(("model_type", "model_attributes_type", "dict_type"))
"""pydantic's error types for a value in place of a section."""
_NUMBERS: Final = frozenset(("greater_than", "greater_than_equal", "less_than", "less_than_equal", "float_parsing", "float_type"))
"""pydantic's error types for a number out of bounds and for a value that is not a number."""


def explain_error(item: Mapping[str, Any], model: type[BaseModel]) -> tuple[list[str], str]:
    """Return the field of an error of pydantic, and what is wrong with it or allowed there."""
    field = [str(part) for part in item["loc"]]
    what = item["msg"].removeprefix("Value error, ").replace("Input should be ", "expected ")
    if item["type"] == "extra_forbidden":
        what = unknown_field(field[-1], model)
    elif item["type"] in _NO_SECTION:
        what = "expected a section, a mapping of fields"
    elif item["type"] == "missing":
        last = field.pop()
        what = f"expected at least {int(last) + 1} values" if last.isdigit() else f"lacks {last}"
    elif item["type"] == "tuple_type":
        what = "expected a list of values in square brackets"
    elif item["type"] == "too_long":
        what = f"expected at most {item['ctx']['max_length']} values"
    elif item["type"] in _NUMBERS and (unit := _unit(field)):
        what += f" (in {unit})"
    return field, what


def _unit(field: Sequence[str]) -> str | None:
    """Return the unit at the end of a field's name: metres for `exam.region_m.0`."""
    name = next((part for part in reversed(field) if not part.isdigit()), "")
    return UNITS.get(name.rpartition("_")[2]) if "_" in name else None


def did_you_mean(word: str, known: Collection[str]) -> str:
    """Return the most similar known word as a sentence; empty if there is none."""
    near = get_close_matches(word, known, n=1)
    return f". Did you mean {near[0]}?" if near else ""


def unknown_field(field: str, model: type[BaseModel]) -> str:
    """Return the message for a field that neither the model nor a nested one has, with the most similar field."""
    schema = model.model_json_schema()
    parts = (schema, *schema.get("$defs", {}).values())
    return f"unknown field{did_you_mean(field, {name for part in parts for name in part.get('properties', ())})}"
