"""docs/scenario.md, from the fields of a scenario."""

import json
from collections.abc import Iterator
from textwrap import fill
from typing import Any, Final, get_args, get_origin

from generate import one_line, table
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


def page() -> str:
    """Return the page."""
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
