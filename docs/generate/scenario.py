"""docs/scenario.md and docs/errors.md, from the fields of a scenario and the table in `error_levels.yaml`."""

import json
from collections.abc import Iterator
from textwrap import fill
from typing import Any, Final, get_args, get_origin

from generate import one_line, table
from palpate_models.scenario.errors import LEVEL, Errors, table as levels
from palpate_models.scenario.schema import Scenario
from palpate_models.section import UNITS, Section

_HEAD: Final = """# Fields of a scenario

Generated from the models in [`palpate_models`](../models/palpate_models/scenario/schema.py) by `make docs`.

A scenario is a YAML file; a field that it does not set has its default. `palpate scenarios` lists the scenarios that come with
Palpate, and `--set` changes a field for one run:

    palpate run my_patient.yaml --set exam.depth_m=0.008 --set errors=none

{units}

A field without a unit is a plain number, a name or a boolean. An unknown field is an error, which names its line and the most
similar field. [V] marks a figure that was read in the source named next to it, [A] an assumed one.
"""
_ELSEWHERE: Final = {
    "errors": "All fields with their levels and sources: [errors.md](errors.md).",
    "phantom.anatomy": "It is not set but drawn from the seed, see [reality.md](reality.md#randomly-drawn-persons).",
}
"""Sections with a page of their own."""
_BOUNDS: Final = {"minimum": "at least", "exclusiveMinimum": "above", "maximum": "at most", "exclusiveMaximum": "below"}


def scenario() -> str:
    """Return docs/scenario.md."""
    units = ", ".join(f"`_{end}` {unit}" for end, unit in UNITS.items())
    return _HEAD.format(units=fill(f"A field's name ends with its unit: {units}.", 128)) + "".join(
        _section("", Scenario, Scenario())
    )


def _section(path: str, model: type[Section], given: Section | None) -> Iterator[str]:
    """Yield a table of the section's own fields, then its inner sections. `given`: its default, or None for an item of a list."""
    schema = model.model_json_schema()
    yield f"\n## {f'`{path}`' if path else 'Top level'}\n\n{one_line(model.__doc__ or '')}\n"
    if path in _ELSEWHERE:
        yield f"\n{_ELSEWHERE[path]}\n"
        return
    inner: list[tuple[str, type[Section], Section | None]] = []
    rows = []
    for name, field in model.model_fields.items():
        where = f"{path}.{name}".strip(".")
        meaning = field.description or ""
        default = field.default if given is None else getattr(given, name)
        kind = field.annotation
        if isinstance(kind, type) and issubclass(kind, Section):
            inner.append((where, kind, default))
            rows.append((f"`{name}`", "", f"a section: [`{where}`](#{_anchor(where)})", meaning or kind.__doc__ or ""))
            continue
        inner += [
            (f"{where}[]" if get_origin(kind) is tuple else where, item, None)
            for item in get_args(kind)
            if isinstance(item, type) and issubclass(item, Section)
        ]
        shown = "required" if given is None and field.is_required() else _default(default)
        rows.append((f"`{name}`", shown, _values(schema["properties"][name], schema.get("$defs", {})), meaning))
    yield "\n" + table(("field", "default", "allowed", "meaning"), rows)
    for place, section, instance in inner:
        yield from _section(place, section, instance)


def _default(value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, float):
        return f"`{value:.6g}`"
    return f"`{value if isinstance(value, str) else json.dumps(value)}`" if value != "" else ""


def _values(schema: dict[str, Any], parts: dict[str, Any]) -> str:
    """Return the allowed values of a field as text."""
    if "$ref" in schema:
        return _values(parts[schema["$ref"].rpartition("/")[2]], parts)
    if "anyOf" in schema:
        return " or ".join(_values(choice, parts) for choice in schema["anyOf"])
    if "enum" in schema or "const" in schema:
        return ", ".join(f"`{value}`" for value in schema.get("enum", [schema.get("const")]))
    if schema.get("type") == "array":
        items = schema.get("prefixItems")
        return (
            f"{len(items)} of: {_values(items[0], parts)}" if items else f"a list of: {_values(schema.get('items', {}), parts)}"
        )
    if schema.get("type") == "object":
        return f"a section ({schema.get('title', 'any fields')})"
    bounds = [f"{word} {schema[key]:.10g}" for key, word in _BOUNDS.items() if key in schema]
    kind = {"number": "a number", "integer": "a whole number", "string": "text", "boolean": "true, false", "null": "none"}
    return " ".join([kind.get(str(schema.get("type")), "anything"), *([", ".join(bounds)] if bounds else [])])


def _anchor(path: str) -> str:
    return path.replace(".", "").replace("[]", "")


_ERRORS: Final = f"""# Errors of sensors, calibrations and arm

Generated from [`errors.py`](../models/palpate_models/scenario/errors.py) and
[`error_levels.yaml`](../models/palpate_models/error_levels.yaml) by `make docs`.

    palpate run --set errors=typical                              a level: none, typical or poor; {LEVEL} is the default
    palpate run --set errors=poor --set errors.force.tare_n=0.1   a level, and one field changed

For each patient one set of equipment is drawn from the scenario's seed. The errors below are standard deviations or bounds of
that draw, as each field says. The simulated robot, tool, sensor and camera, and the true pose of the patient, have these errors.
Control, planning, perception, assessment and supervisor use the nominal equipment, as on hardware, and get neither the errors nor
the seed. Drivers of real hardware (`lbr`, `ros`) ignore this section; the emulator of the LBR uses it.

The level `none` is an ideal world for tests. It keeps the white noise of good sensors, and the constant bias of a force/torque
sensor, which every examination tares. `offset` of a pose adds a chosen error to the drawn one.

Marks of certainty: V read in the source (mostly abstracts and issue threads; "name #n" is an issue of that repository), S
second-hand, C computed for this project, A assumed. A mark in brackets inside a source applies to the words before it.

Not modelled: a tool mounted at an angle, bent joint axes, motor dynamics of a flexible joint, distortion of the camera's lens,
depth errors that grow with distance, hysteresis of the force/torque sensor.
"""


def errors() -> str:
    """Return docs/errors.md."""
    return _ERRORS + "".join(_error_sections())


def _error_sections() -> Iterator[str]:
    nominal = Errors(level="none")
    for name, rows in levels().items():
        section = getattr(nominal, name)
        yield f"\n## `errors.{name}`\n\n{one_line(Errors.model_fields[name].description or type(section).__doc__ or '')}\n\n"
        yield table(
            ("field", "meaning", "none", "typical", "poor", "mark", "source"),
            [
                (
                    f"`{field}`",
                    type(section).model_fields[field].description or "",
                    *(f"{value:g}" for value in (getattr(section, field), row["typical"], row["poor"])),
                    row["mark"],
                    row["source"],
                )
                for field, row in rows.items()
            ],
        )
