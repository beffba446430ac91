"""Loads scenarios from YAML, by name or file, with `--set a.b=c`, and gives each role its view; and the checkpoint of an
interrupted examination: its measurements, for the run that resumes it.

Errors name file, line, field, value and what is allowed.
"""

import io
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any, Literal

import numpy as np
import yaml
from pydantic import BaseModel, ValidationError

from palpate_errors import UserError, restate
from palpate_inputs import brief, parse_yaml, read_arrays, read_text
from palpate_models.numerics.frames import Array, matrix, pose_of
from palpate_models.scenario.errors import draw_errors
from palpate_models.scenario.schema import ExamInput, PlantInput, Scenario
from palpate_models.section import Pose, did_you_mean, explain_error


def explain(name: str, text: str, settings: Sequence[str], model: type[BaseModel], error: ValidationError) -> str:
    """Return a line per invalid value of the scenario `name`, given as YAML in `text` and changed by `a.b=c` settings."""
    lines = []
    for item in error.errors()[:_EXPLAINED]:
        field, what = explain_error(item, model)
        path = ".".join(field) or "scenario"
        of_section = isinstance(item["input"], BaseModel)  # the default section: `what` names the field and its value
        what = what if of_section else f"{path} = {brief(item['input'])}: {what}"
        lines.append(f"{_origin(name, text, settings, field)}: {what}")
    return "\n".join(lines)


_EXPLAINED = 20
"""Invalid values that a message lists."""


def _origin(name: str, text: str, settings: Sequence[str], field: Sequence[str]) -> str:
    """Return the source of a field's value: the last setting that wrote it, else file and line."""
    written = [setting.partition("=")[0].split(".") for setting in reversed(settings)]
    to_it = [words for words in written if words == list(field[: len(words)])]
    within = [one for one in written if field and one[: len(field)] == list(field)]  # of a section that is invalid as a whole
    for words in (*to_it, *within):
        return f"--set {'.'.join(words)}"
    line = _line(yaml.compose(text, yaml.SafeLoader), field)
    return name if line is None else f"{name}, line {line}"


def _line(node: yaml.Node | None, field: Iterable[str]) -> int | None:
    """Return the line of a field, counted from 1; None if the document does not have it."""
    line = None
    for word in field:
        if isinstance(node, yaml.MappingNode):
            found = [(key, value) for key, value in node.value if key.value == word]
        elif isinstance(node, yaml.SequenceNode) and word.isdigit() and int(word) < len(node.value):
            found = [(node.value[int(word)],) * 2]
        else:
            found = []
        if not found:
            return line  # the path of a validator may be deeper than the document
        key, node = found[0]
        line = key.start_mark.line + 1
    return line


View = Literal["scenario", "plant", "exam"]
"""Views of a scenario; a run's folder has a file of each."""
_PATIENT: dict[str, Any] = {"name": True, "description": True, "phantom": True, "tissue": True, "services": {"tissue"}}
HIDDEN: Mapping[View, dict[str, Any]] = {"scenario": {}, "plant": _PATIENT, "exam": {**_PATIENT, "seed": True, "errors": True}}
"""Fields left out of each view: the patient for the plant; also seed and errors for the examination."""
_SEES_ALL, _SEES_ERRORS = ("tissue", "dashboard", "recorder"), ("robot", "camera")


class ScenarioError(UserError):
    """A scenario that cannot be used. The message names file, field, value and what is allowed."""


def scenario_names() -> tuple[str, ...]:
    """Return the names of the built-in scenarios."""
    folder = resources.files("palpate_models").joinpath("scenarios")
    return tuple(sorted(Path(item.name).stem for item in folder.iterdir() if item.name.endswith(".yaml")))


def _read(source: str) -> tuple[str, str]:
    """Return text and display name of a scenario given by name or file."""
    if source in scenario_names():
        name = f"{source}.yaml"
        return resources.files("palpate_models").joinpath("scenarios", name).read_text(encoding="utf-8"), name
    path = Path(source)
    if path.is_dir():
        raise ScenarioError(f"{source}: is a folder; expected a YAML file, such as the scenario.yaml of a run")
    if path.suffix in (".yaml", ".yml") and not path.exists():
        raise ScenarioError(f"{source}: there is no such file")
    if not path.is_file():
        raise ScenarioError(
            f"{source}: no such scenario; known are {', '.join(scenario_names())}, or give the path of a YAML file"
            f"{did_you_mean(source, scenario_names())}"
        )
    return read_text(path, ScenarioError), source


def _override(raw: dict[str, Any], setting: str) -> None:
    """Apply one `a.b=c` to nested mappings; the value is YAML."""
    field, separator, value = setting.partition("=")
    if not separator or not field:
        raise ScenarioError(f"--set {setting}: expected field.path=value, e.g. exam.depth_m=0.008")
    *parents, last = field.split(".")
    node: Any = raw
    for parent in parents:
        node = node[_index(node, parent, setting)] if isinstance(node, list) else node.setdefault(parent, {})
        if not isinstance(node, dict | list):
            raise ScenarioError(f"--set {setting}: {parent!r} is a value, not a section")
    node[_index(node, last, setting) if isinstance(node, list) else last] = parse_yaml(value, f"--set {setting}", ScenarioError)


def _index(items: list[Any], word: str, setting: str) -> int:
    """Return the index of an existing item."""
    if not (word.isascii() and word.isdigit() and int(word) < len(items)):
        raise ScenarioError(f"--set {setting}: {word!r} is not an item; there are {len(items)}, counted from 0")
    return int(word)


def load_scenario(source: str, settings: Sequence[str] = (), seed: int | None = None) -> Scenario:
    """Return a scenario by name or YAML file, with overrides `a.b=c` applied in order. Raises ScenarioError."""
    text, name = _read(source)
    raw = parse_yaml(text, name, ScenarioError) or {}
    if not isinstance(raw, dict):
        raise ScenarioError(f"{name}: expected a mapping of fields, not {type(raw).__name__}")
    raw.setdefault("name", Path(name).stem)
    phantom = raw.get("phantom")
    if isinstance(phantom, dict) and isinstance(phantom.get("grid"), str):
        phantom["grid"] = str(Path(source).absolute().parent / phantom["grid"])
    for setting in settings:
        if isinstance(raw.get("errors"), str):  # a level's name stands for a mapping with only the level
            raw["errors"] = {"level": raw["errors"]}
        _override(raw, setting)
    if seed is not None:
        raw["seed"] = seed
    try:
        return Scenario.model_validate(raw)
    except ValidationError as error:
        raise ScenarioError(explain(name, text, settings, Scenario, error)) from error


def as_settings(fields: Mapping[str, Any]) -> list[str]:
    """Return fields by path as overrides `a.b=c` for `load_scenario`. Raises ScenarioError for values that YAML cannot hold."""
    with restate((TypeError, ValueError), ScenarioError, f"{', '.join(fields)}: expected numbers, words, lists and mappings"):
        return [f"{path}={json.dumps(value)}" for path, value in fields.items()]


def whole_scenario(source: str | Path | Scenario, seed: int | None = None) -> Scenario:
    """Return a scenario by name or YAML file, or a loaded one unchanged.

    Raises ScenarioError as `load_scenario` does, and if `seed` differs from that of a loaded scenario.
    """
    if not isinstance(source, Scenario):
        return load_scenario(str(source), seed=seed)
    if seed not in (None, source.seed):
        raise ScenarioError(f"{source.name}: seed = {seed}: drawn from seed {source.seed}; give the seed with its name or file")
    return source


def view_of(role: str) -> View:
    """Return the view of a role: everything for observers and tissue, errors for simulated hardware, else the examination."""
    return "scenario" if role in _SEES_ALL else "plant" if role in _SEES_ERRORS else "exam"


def restrict_to_view(scenario: Scenario, view: View) -> Scenario:
    """Return the scenario in a view: hidden fields have their defaults."""
    return Scenario.model_validate(scenario.model_dump(exclude=HIDDEN[view]))


def dump_scenario(scenario: Scenario, view: View = "scenario") -> str:
    """Return a view as YAML; `load_scenario` reads it back as `restrict_to_view` returns it, except for the name."""
    given = scenario.model_dump(mode="json", exclude=HIDDEN[view])
    return str(yaml.safe_dump(given, sort_keys=False, allow_unicode=True))


def exam_input(scenario: Scenario) -> ExamInput:
    """Return the inputs of every role."""
    return ExamInput(**_exam(scenario))


def plant_input(scenario: Scenario) -> PlantInput:
    """Return the inputs of the simulated robot and camera."""
    return PlantInput(**_exam(scenario), seed=scenario.seed, errors=scenario.errors)


def _exam(scenario: Scenario) -> dict[str, Any]:
    X_WA = tuple(tuple(row) for row in matrix(scenario.exam.pose).tolist())
    return {"X_WA": X_WA, **{name: getattr(scenario, name) for name in ("exam", "robot", "camera", "limits")}}


def true_pose(scenario: Scenario) -> Pose:
    """Return the true X_WA: the registered pose composed with the error of registration.

    For tissue and scoring only: it needs a scenario with its errors.
    """
    return pose_of(matrix(scenario.exam.pose) @ draw_errors(scenario.errors, scenario.seed).X_AAt)


class CheckpointError(UserError):
    """A checkpoint that cannot be used. Names the file and what is wrong."""


FELT = (
    *("time", "position", "normal", "velocity", "depth", "force", "force_noise", "time_in_contact", "force_limited", "stroke"),
    *("depth_uncertainty", "exponent"),
)
"""Columns of the samples: the fields of `ForceSample` of the assessment."""


@dataclass(frozen=True)
class Checkpoint:
    """State of an examination at its interruption."""

    felt: Mapping[str, Any]
    """Columns `FELT` of m samples, in A, shape (m,) or (m, 3). Their times [s] are negative: before the resumed run."""
    left: Array
    """Targets that were not reached, in A [m], shape (k, 2)."""
    surface: Array
    """Vertices of the perceived surface, in A [m], shape (n, 3)."""
    strokes: int
    """Number of descents."""

    def remaining_targets(self, targets: Array, spacing: float) -> frozenset[int]:
        """Return the indices of new targets, in A [m], shape (j, 2), within half a `spacing` [m] of a remaining one."""
        away = np.linalg.norm(targets[:, None] - self.left, axis=-1)
        return frozenset(np.flatnonzero((away < spacing / 2).any(axis=1)).tolist())

    def bytes(self) -> bytes:
        """Return the content of the file."""
        file = io.BytesIO()
        np.savez_compressed(file, left=self.left, surface=self.surface, strokes=np.array(self.strokes), **self.felt)
        return file.getvalue()


def read_checkpoint(path: Path | None) -> Checkpoint | None:
    """Return the checkpoint in a file; None without a path. Raises CheckpointError."""
    if path is None:
        return None
    held = dict(read_arrays(path, path, CheckpointError))
    with restate((ValueError, KeyError, TypeError), CheckpointError, f"{path}: not a checkpoint of this version"):
        left, surface, strokes = (held.pop(name) for name in ("left", "surface", "strokes"))
        if held.keys() != set(FELT):
            raise ValueError(f"samples of {', '.join(held)}; expected {', '.join(FELT)}")
        rows = len(held["time"])
        wanted: dict[str, tuple[int, ...]] = {
            name: (rows, 3) if name in ("position", "normal", "velocity") else (rows,) for name in held
        }
        wanted |= {"left": (len(left), 2), "surface": (len(surface), 3), "strokes": ()}
        for name, array in {**held, "left": left, "surface": surface, "strokes": strokes}.items():
            if array.shape != wanted[name] or array.dtype.kind not in "bif" or not np.isfinite(array).all():
                raise ValueError(f"{name}: expected finite numbers of shape {wanted[name]}, got {array.dtype} {array.shape}")
        return Checkpoint(held, left, surface, int(strokes))
