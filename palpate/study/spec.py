"""The specification of a study: its patients, equipment errors and methods. YAML, as strict as a scenario.

    name: mine
    populations:
      healthy: {scenario: person, number: {test: 20}}
      lumps:   {scenario: person, number: {test: 20}, lumps: {radius_m: [0.008, 0.020], contrast: {grid: [2, 4, 8]}}}
    methods: {palpate: {}, mine: {services: {assessment: mine.py}}}

Every patient of every population is examined with every entry of `errors` by every method, so that all comparisons are paired.
"""

from collections.abc import Mapping, Sequence
from importlib import resources
from itertools import product
from pathlib import Path
from typing import Annotated, Any, Final, Literal, Self

from pydantic import Field, ValidationError, model_validator

from palpate.run.roles import ROLES
from palpate.study.shift import Family
from palpate_errors import UserError
from palpate_inputs import parse_yaml, read_text
from palpate_models.patient.schema import Count, Draw
from palpate_models.scenario.errors import Errors, Level, table
from palpate_models.scenario.load import explain
from palpate_models.section import Ends, Length, Section

Split = Literal["tune", "test", "shift"]
"""`tune`: patients for choosing thresholds. `test`: patients whose figures are reported. `shift`: patients and equipment from
other sources than the population's (`palpate.study.shift`), reported apart."""
Tier = Literal["whole", "quick"]
"""`whole`: the composed run of all services. `quick`: the indenter without an arm (`palpate.quick`)."""
Runtime = Literal["lockstep", "wallclock"]
QUICK: Final = ("tissue", "assessment")
"""Roles of the tier quick."""
Name = Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9_.-]{0,39}$")]
Range = tuple[float, float]
"""Minimum and maximum, which `Draw` checks."""
Settings = dict[str, Any]
"""Fields of a scenario by their path, such as `exam.depth_m: 0.008`."""

SUFFIX: Final = ".yaml"


class StudyError(UserError):
    """An invalid study. The message names file, field, value and what is allowed."""


class Numbers(Section):
    """Number of patients per split."""

    tune: Annotated[int, Field(ge=0, le=1000)] = 0
    test: Annotated[int, Field(ge=0, le=1_000_000)] = 0
    shift: dict[Family, Annotated[int, Field(ge=0, le=1_000_000)]] = Field(default_factory=dict)
    """By family."""


class Grid(Section):
    """Values that are assigned to patients in turn; with several grids, all combinations of their values."""

    grid: Annotated[tuple[float, ...], Field(min_length=1)]


class Lumps(Section):
    """Lumps that are drawn for each patient from their seed. Ranges are (minimum, maximum), as in `phantom.draw`."""

    count: Ends[Count] = (1, 1)
    """Number of lumps per patient."""
    radius_m: Range | Grid = Draw().radius_m
    elongation: Range | Grid = Draw().elongation
    depth_m: Range | Grid = Draw().depth_m
    contrast: Range | Grid = Draw().contrast
    pairs: Annotated[float, Field(ge=0, le=1)] = 0.0
    place: Literal["inside", "edge"] = "inside"
    region_m: tuple[Length, Length] = Draw().region_m

    @model_validator(mode="after")
    def _drawable(self) -> Self:
        for draw in self.cells():
            Draw.model_validate(draw)
        return self

    def cells(self) -> list[dict[str, Any]]:
        """Return `phantom.draw` for each combination of the grids; one without grids."""
        grids = {name: value.grid for name in type(self).model_fields if isinstance(value := getattr(self, name), Grid)}
        plain = self.model_dump(mode="json", exclude={"count", *grids})
        return [
            {"lumps": self.count, **plain, **{name: [value, value] for name, value in zip(grids, values, strict=True)}}
            for values in product(*grids.values())
        ]


class Population(Section):
    """Patients of one kind."""

    scenario: str
    """Name of a scenario, or a YAML file; a relative path starts from the folder of the study's file."""
    number: Numbers = Numbers()
    settings: Settings = Field(default_factory=dict)
    lumps: Lumps | None = None
    """Lumps in addition to those of the scenario, which must have `kind: person`."""


class Method(Section):
    """A method of examination, as changes of the scenario."""

    settings: Settings = Field(default_factory=dict)
    services: dict[str, str] = Field(default_factory=dict)
    """Implementation by role: an installed one, or a Python file; a relative path starts from the folder of the study's file."""
    runtime: Runtime = "lockstep"
    """`wallclock`: one process per service, each on its own timer. Results depend on the machine, without a digest."""
    periods: dict[str, Annotated[int, Field(ge=1, le=1000)]] = Field(default_factory=dict)
    """Other periods of roles [ms], such as `control: 5`."""

    @model_validator(mode="after")
    def _roles(self) -> Self:
        for field, roles in (("services", self.services), ("periods", self.periods)):
            if wrong := [role for role in roles if role not in ROLES]:
                raise ValueError(f"{field}.{wrong[0]}: expected one of {', '.join(ROLES)}")
        return self


class Study(Section):
    """A study."""

    name: Name
    description: str = ""
    tier: Tier = "whole"
    salt: str = ""
    """Changes every patient of the splits `test` and `shift`."""
    seeds_sha256: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")] | None = None
    """For a held-out study: SHA-256 of the file of secret seeds, which the splits `test` and `shift` need."""
    populations: Annotated[dict[Name, Population], Field(min_length=1)]
    errors: dict[Name, Errors] = Field(default_factory=dict)
    """Equipment errors by name; without any, those of the scenarios."""
    each_error: tuple[str, ...] = ()
    """Errors that are also examined one at a time: a section such as `camera`, or a field such as `force.tare_n`."""
    each_error_at: tuple[Level, ...] = ()
    """Levels of `each_error`; all other errors are those of the first entry of `errors`."""
    methods: Annotated[dict[Name, Method], Field(min_length=1)] = Field(default_factory=lambda: {"palpate": Method()})

    @model_validator(mode="after")
    def _each(self) -> Self:
        if bool(self.each_error) != bool(self.each_error_at) or (self.each_error and not self.errors):
            raise ValueError(
                "each_error and each_error_at need each other, and errors, whose first entry has the values of all other errors"
            )
        allowed = [*table(), *(f"{section}.{field}" for section, rows in table().items() for field in rows)]
        if wrong := [name for name in self.each_error if name not in allowed]:
            raise ValueError(f"each_error = {wrong[0]!r}: expected one of {', '.join(allowed)}")
        methods = self.methods.values() if self.tier == "quick" else ()
        if any(method.runtime == "wallclock" or method.periods or method.services.keys() - QUICK for method in methods):
            raise ValueError(f"runtime: wallclock, periods, and services of a method but {' and '.join(QUICK)}, need tier: whole")
        return self

    def error_levels(self) -> dict[str, Errors | None]:
        """Return the equipment errors by name: `errors`, and `name=level` for each single error.

        None stands for the errors of the scenario. A level that equals the first entry of `errors` is left out.
        """
        if not self.errors:
            return {"": None}
        found: dict[str, Errors | None] = dict(self.errors)
        base = next(iter(self.errors.values()))
        for name, level in product(self.each_error, self.each_error_at):
            section, _, field = name.partition(".")
            usual, changed = getattr(Errors(level=level), section), getattr(base, section)
            changed = changed.model_copy(update={field: getattr(usual, field)}) if field else usual
            if changed != getattr(base, section):
                found[f"{name}={level}"] = base.model_copy(update={section: changed})
        return found


def study_names() -> tuple[str, ...]:
    """Return the names of the studies that come with Palpate."""
    folder = resources.files("palpate.study").joinpath("studies")
    return tuple(sorted(item.name.removesuffix(SUFFIX) for item in folder.iterdir() if item.name.endswith(SUFFIX)))


def load_study(source: str) -> Study:
    """Return a study by name or YAML file, with absolute paths of files. Raises StudyError."""
    if source in study_names():
        path = Path(str(resources.files("palpate.study").joinpath("studies", source + SUFFIX)))
    else:
        path = Path(source)
        if not path.is_file():
            raise StudyError(f"{source}: no such study; known are {', '.join(study_names())}, or give the path of a YAML file")
    text = read_text(path, StudyError)
    raw = parse_yaml(text, source, StudyError)
    if not isinstance(raw, Mapping):
        raise StudyError(f"{source}: expected a mapping of fields, not {type(raw).__name__}")
    try:
        study = Study.model_validate({"name": path.stem, **raw})
    except ValidationError as error:
        raise StudyError(explain(source, text, (), Study, error)) from error
    populations = {
        key: population.model_copy(update={"scenario": _file(population.scenario, path.parent, SUFFIX)})
        for key, population in study.populations.items()
    }
    methods = {key: _absolute(method, path.parent) for key, method in study.methods.items()}
    return study.model_copy(update={"populations": populations, "methods": methods})


def with_methods(study: Study, only: Sequence[str] | None) -> Study:
    """Return the study with only these methods, or with all. Raises StudyError for an unknown one."""
    if wrong := [name for name in only or () if name not in study.methods]:
        raise StudyError(f"{study.name}: there is no method {wrong[0]!r}: expected one of {', '.join(study.methods)}")
    return study.model_copy(update={"methods": {name: own for name, own in study.methods.items() if not only or name in only}})


def with_services(study: Study, services: Mapping[str, str]) -> Study:
    """Return the study with a further method of these services, which has the name of the first one. Raises StudyError."""
    try:
        own = _absolute(Method(services=dict(services)), Path())
        name = Path(next(iter(services.values()))).stem.lower()
        return Study.model_validate({**dict(study), "methods": {**study.methods, name: own}})
    except ValidationError as error:
        raise StudyError(f"{study.name}: {error.errors()[0]['msg'].removeprefix('Value error, ')}") from error


def _absolute(method: Method, folder: Path) -> Method:
    return method.model_copy(update={"services": {role: _file(word, folder, ".py") for role, word in method.services.items()}})


def _file(word: str, folder: Path, suffix: str) -> str:
    """Return a name unchanged, a file as absolute path."""
    return str((folder / word).resolve()) if word.endswith(suffix) else word
