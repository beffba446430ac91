"""Scenarios from YAML, by name or file, with `--set a.b=c`. Errors name file, field, value and what is allowed."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any, Literal

import yaml
from pydantic import ValidationError

from palpate_errors import UserError
from palpate_models.numerics.frames import matrix, pose_of
from palpate_models.scenario.errors import draw_errors
from palpate_models.scenario.explain import did_you_mean, explain
from palpate_models.scenario.schema import ExamInput, PlantInput, Scenario
from palpate_models.section import Pose

View = Literal["scenario", "plant", "exam"]
"""How much of a scenario a role is given; a run's folder has a file of each kind."""
_PATIENT: dict[str, Any] = {"name": True, "description": True, "phantom": True, "tissue": True, "services": {"tissue"}}
HIDDEN: Mapping[View, dict[str, Any]] = {
    "scenario": {},
    "plant": _PATIENT,
    "exam": {**_PATIENT, "seed": True, "errors": True},
}
"""What is left out: of the plant's view what tells of the patient, of the exam's also what the truth could be drawn from."""
_VIEWS: Mapping[str, View] = {
    "tissue": "scenario",
    "dashboard": "scenario",
    "recorder": "scenario",
    "robot": "plant",
    "camera": "plant",
}
_MERGE = "tag:yaml.org,2002:merge"


class ScenarioError(UserError):
    """A scenario that cannot be used. The message names file, field, value and what is allowed."""


class _TwiceError(ValueError):
    """A field that a mapping has twice."""


class _Loader(yaml.SafeLoader):
    """YAML in which a field stands once; PyYAML would take the last of two and say nothing."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """The mapping. Raises _TwiceError naming line and field."""
        seen = set()
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode) and key.tag != _MERGE:
                if key.value in seen:
                    raise _TwiceError(f"line {key.start_mark.line + 1}: field {key.value} stands twice; want it once")
                seen.add(key.value)
        return super().construct_mapping(node, deep)


def scenario_names() -> tuple[str, ...]:
    """Names of the scenarios that come with the package."""
    folder = resources.files("palpate_models").joinpath("scenarios")
    return tuple(sorted(Path(item.name).stem for item in folder.iterdir() if item.name.endswith(".yaml")))


def _read(source: str) -> tuple[str, str]:
    """Text and display name of a scenario given by name or by file."""
    if source in scenario_names():
        name = f"{source}.yaml"
        return resources.files("palpate_models").joinpath("scenarios", name).read_text(encoding="utf-8"), name
    path = Path(source)
    if path.is_dir():
        raise ScenarioError(f"{source}: is a folder; want a YAML file, such as the scenario.yaml of a run")
    if path.suffix in (".yaml", ".yml") and not path.exists():
        raise ScenarioError(f"{source}: there is no such file")
    if not path.is_file():
        raise ScenarioError(
            f"{source}: no such scenario; known are {', '.join(scenario_names())}, or give the path of a YAML file"
            f"{did_you_mean(source, scenario_names())}"
        )
    try:
        return path.read_text(encoding="utf-8"), source
    except UnicodeDecodeError as error:
        raise ScenarioError(f"{source}: not UTF-8: {error.reason} at byte {error.start}") from error


def _override(raw: dict[str, Any], setting: str) -> None:
    """Applies one `a.b=c` to nested mappings; the value is YAML."""
    field, separator, value = setting.partition("=")
    if not separator or not field:
        raise ScenarioError(f"--set {setting}: want field.path=value, e.g. exam.depth_m=0.008")
    *parents, last = field.split(".")
    node: Any = raw
    for parent in parents:
        node = node[_index(node, parent, setting)] if isinstance(node, list) else node.setdefault(parent, {})
        if not isinstance(node, dict | list):
            raise ScenarioError(f"--set {setting}: {parent!r} is a value, not a section")
    node[_index(node, last, setting) if isinstance(node, list) else last] = parse_yaml(value, f"--set {setting}")


def _index(items: list[Any], word: str, setting: str) -> int:
    """The index of an item that is there."""
    if not (word.isascii() and word.isdigit() and int(word) < len(items)):
        raise ScenarioError(f"--set {setting}: {word!r} is no item; there are {len(items)}, counted from 0")
    return int(word)


def parse_yaml(text: str, name: str) -> Any:
    """YAML as Python values. Raises ScenarioError naming the file `name` and what is wrong."""
    try:
        return yaml.load(text, _Loader)
    except _TwiceError as error:
        raise ScenarioError(f"{name}: {error}") from error
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        where = "" if mark is None else f", line {mark.line + 1}, column {mark.column + 1}"
        why = ", ".join(part for part in (error.problem, error.context) if part)
        raise ScenarioError(f"{name}{where}: not YAML: {why}") from error
    except (yaml.YAMLError, ValueError, RecursionError) as error:  # ValueError for 2001-13-45, RecursionError for deep nesting
        raise ScenarioError(f"{name}: not YAML: {error}") from error


def load_scenario(source: str, settings: Sequence[str] = (), seed: int | None = None) -> Scenario:
    """A scenario by name or YAML file, with overrides `a.b=c` applied in order.

    Raises ScenarioError naming file, field, value and what is allowed.
    """
    text, name = _read(source)
    raw = parse_yaml(text, name) or {}
    if not isinstance(raw, dict):
        raise ScenarioError(f"{name}: want a mapping of fields, not {type(raw).__name__}")
    raw.setdefault("name", Path(name).stem)
    for setting in settings:
        if isinstance(raw.get("errors"), str):  # a level's name is short for a mapping with it alone
            raw["errors"] = {"level": raw["errors"]}
        _override(raw, setting)
    if seed is not None:
        raw["seed"] = seed
    try:
        return Scenario.model_validate(raw)
    except ValidationError as error:
        raise ScenarioError(explain(name, text, settings, Scenario, error)) from error


def as_settings(fields: Mapping[str, Any]) -> list[str]:
    """Overrides `a.b=c` of fields by their path, each with its value: what `load_scenario` takes.

    Raises ScenarioError for a value that no scenario can have.
    """
    try:
        return [f"{path}={json.dumps(value)}" for path, value in fields.items()]
    except (TypeError, ValueError) as error:
        raise ScenarioError(f"{', '.join(fields)}: want numbers, words, lists and mappings: {error}") from error


def whole_scenario(source: str | Path | Scenario, seed: int | None = None) -> Scenario:
    """A scenario by name or YAML file, or one that is there already, which has a seed of its own.

    Raises ScenarioError as `load_scenario` does, and for a seed that is given with a scenario of another.
    """
    if not isinstance(source, Scenario):
        return load_scenario(str(source), seed=seed)
    if seed not in (None, source.seed):
        raise ScenarioError(
            f"{source.name}: seed = {seed}: this scenario was drawn from seed {source.seed}; give the seed with its name or file"
        )
    return source


def view_of(role: str) -> View:
    """What a role is given: observers and the tissue all, what stands for equipment its errors, everybody else the exam."""
    return _VIEWS.get(role, "exam")


def seen(scenario: Scenario, view: View) -> Scenario:
    """The scenario as that view has it: what is hidden is as in a scenario that does not mention it."""
    return Scenario.model_validate(scenario.model_dump(exclude=HIDDEN[view]))


def dump_scenario(scenario: Scenario, view: View = "scenario") -> str:
    """A view of the scenario as YAML, which `load_scenario` reads back to what `seen` returns, but for the name."""
    given = scenario.model_dump(mode="json", exclude=HIDDEN[view])
    return str(yaml.safe_dump(given, sort_keys=False, allow_unicode=True))


def exam_input(scenario: Scenario) -> ExamInput:
    """What every role may know."""
    return ExamInput(**_exam(scenario))


def plant_input(scenario: Scenario) -> PlantInput:
    """What the simulated robot and camera may know."""
    return PlantInput(**_exam(scenario), seed=scenario.seed, errors=scenario.errors)


def _exam(scenario: Scenario) -> dict[str, Any]:
    return {
        "X_WA": tuple(tuple(row) for row in matrix(scenario.exam.pose).tolist()),
        "exam": scenario.exam,
        "robot": scenario.robot,
        "camera": scenario.camera,
        "limits": scenario.limits,
    }


def true_pose(scenario: Scenario) -> Pose:
    """X_WA: where the patient truly is, the registered pose composed with what registration got wrong.

    For the tissue and scoring; a scenario of which the errors are hidden does not know it.
    """
    return pose_of(matrix(scenario.exam.pose) @ draw_errors(scenario.errors, scenario.seed).X_AAt)
