"""Why a scenario cannot be used: where each wrong value came from, what is wrong with it, and what was probably meant."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from difflib import get_close_matches
from typing import Any

import yaml
from pydantic import BaseModel, ValidationError

from palpate_models.section import UNITS


def did_you_mean(word: str, known: Collection[str]) -> str:
    """The known word that is nearest, as a sentence that can follow another one; empty when none is near."""
    near = get_close_matches(word, known, n=1)
    return f". Did you mean {near[0]}?" if near else ""


def explain(name: str, text: str, settings: Sequence[str], model: type[BaseModel], error: ValidationError) -> str:
    """A line for each wrong value of a scenario called `name`, written as YAML in `text` and changed by `a.b=c` settings."""
    lines = []
    for item in error.errors():
        field = [str(part) for part in item["loc"]]
        what = item["msg"].removeprefix("Value error, ").replace("Input should be ", "want ")
        if item["type"] == "extra_forbidden":
            what = f"there is no such field{did_you_mean(field[-1], _fields(model.model_json_schema()))}"
        elif item["type"] in _NO_SECTION:
            what = "want a section, a mapping of fields"
        elif item["type"] == "missing":
            last = field.pop()
            what = f"want at least {int(last) + 1} values" if last.isdigit() else f"lacks {last}"
        elif item["type"] == "tuple_type":
            what = "want a list of values in square brackets"
        elif item["type"] == "too_long":
            what = f"want at most {item['ctx']['max_length']} values"
        elif item["type"] in _NUMBERS and (unit := _unit(field)):
            what += f" (in {unit})"
        path = ".".join(field) or "scenario"
        lines.append(f"{_origin(name, text, settings, field)}: {path} = {item['input']!r}: {what}")
    return "\n".join(lines)


_NO_SECTION = frozenset(("model_type", "model_attributes_type", "dict_type"))
"""What pydantic calls a value in place of a section."""


_NUMBERS = frozenset(("greater_than", "greater_than_equal", "less_than", "less_than_equal", "float_parsing", "float_type"))
"""What pydantic calls a number out of its bounds, and a value in place of a number."""


def _unit(field: Sequence[str]) -> str | None:
    """The unit that the name of a field ends with: of `exam.region_m.0` metres."""
    name = next((part for part in reversed(field) if not part.isdigit()), "")
    return UNITS.get(name.rpartition("_")[2]) if "_" in name else None


def _fields(schema: dict[str, Any]) -> set[str]:
    """The names of all fields of a model and of the models within it."""
    return {field for part in (schema, *schema.get("$defs", {}).values()) for field in part.get("properties", ())}


def _origin(name: str, text: str, settings: Sequence[str], field: Sequence[str]) -> str:
    """Where a field got its value: the last setting that wrote it, else the file with the line."""
    written = [setting.partition("=")[0].split(".") for setting in reversed(settings)]
    to_it = [words for words in written if words == list(field[: len(words)])]
    within = [words for words in written if field and words[: len(field)] == list(field)]  # of a section that is wrong as a whole
    for words in (*to_it, *within):
        return f"--set {'.'.join(words)}"
    line = _line(yaml.compose(text, yaml.SafeLoader), field)
    return name if line is None else f"{name}, line {line}"


def _line(node: yaml.Node | None, field: Iterable[str]) -> int | None:
    """The line on which a field stands, counted from 1; None where the document does not have it."""
    line = None
    for word in field:
        if isinstance(node, yaml.MappingNode):
            found = [(key, value) for key, value in node.value if key.value == word]
        elif isinstance(node, yaml.SequenceNode) and word.isdigit() and int(word) < len(node.value):
            found = [(node.value[int(word)],) * 2]
        else:
            found = []
        if not found:
            return line  # a validator's own words may go deeper than the document
        key, node = found[0]
        line = key.start_mark.line + 1
    return line
