"""The cases of a study: every patient, with every entry of errors, by every method; each under a name made from its content.

A patient's seed is a hash of study, population, split, number and salt, and of nothing else: neither method nor errors, so that
comparisons are paired, and neither worker nor order, so that every way to run the study examines the same patients.
"""

from __future__ import annotations

import hashlib
import json
import shlex
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, Final, NamedTuple

from palpate.run.roles import checked
from palpate.study.spec import Method, Population, Runtime, Split, Study, StudyError, Tier
from palpate_models.patient.mesh import MeshError
from palpate_models.patient.phantom import build_phantom
from palpate_models.scenario.errors import Errors
from palpate_models.scenario.load import ScenarioError, as_settings, load_scenario
from palpate_models.scenario.schema import Scenario
from palpate_models.section import Section
from palpate_plugins import PluginError, is_file

ID_DIGITS: Final = 16
TUNE_SEEDS: Final = 1000
"""Seeds below this are for tuning alone."""
MOST_SEEDS: Final = 2**31
MATTERS_NOT: Final = ("name", "description")
"""Fields of a scenario that decide nothing of a result."""


class Case(Section):
    """One examination of one patient."""

    case_id: str
    population: str
    method: str
    errors: str
    """What is wrong with the equipment: the name in the study."""
    split: Split
    number: int
    """Which patient of the population, from 0."""
    seed: int
    tier: Tier
    runtime: Runtime
    periods: dict[str, int]
    scenario: dict[str, Any]
    """All of the scenario, with everything drawn that a person is made of."""
    files: dict[str, str]
    """SHA-256 of each file that the scenario names, by its path."""

    @property
    def label(self) -> str:
        """Population, number, method and errors, for messages."""
        return " ".join(filter(None, (self.population, str(self.number), self.method, self.errors)))


class Request(NamedTuple):
    """What of a study is asked for."""

    split: Split = "test"
    number: int | None = None
    """Patients of each population that has any, instead of the study's own numbers."""
    settings: Sequence[str] = ()
    """Overrides `a.b=c` of every scenario, after all others."""
    secret: str | None = None
    """What the file of secret seeds holds: it takes the place of the study's salt in the split `test`."""


def command_of(name: str, request: Request, methods: Sequence[str] = (), services: Sequence[str] = ()) -> str:
    """The command that runs a study again, by its name or file. FILE stands for the file of secret seeds."""
    options: dict[str, Sequence[str]] = {
        "--split": [request.split],
        "--number": [] if request.number is None else [str(request.number)],
        "--method": methods,
        "--service": services,
        "--set": request.settings,
        "--seeds-file": [] if request.secret is None else ["FILE"],
    }
    words = [word for option, values in options.items() for value in values for word in (option, value)]
    return shlex.join(["palpate", "study", name, *words])


def patient_seeds(study: str, population: str, split: Split, count: int, salt: str) -> list[int]:
    """The seeds of the first patients of a population, no two alike: 0 to 999 to tune, others to test.

    More patients of a population never change the seeds of those before them.
    """
    first, room = (0, TUNE_SEEDS) if split == "tune" else (TUNE_SEEDS, MOST_SEEDS - TUNE_SEEDS)
    found: dict[int, None] = {}
    for number in range(count):
        attempt = 0
        while True:
            words = [study, population, split, number, "" if split == "tune" else salt, *([attempt] if attempt else [])]
            seed = first + int.from_bytes(hashlib.sha256(_canonical(words)).digest()[:8], "big") % room
            if seed not in found:
                break
            attempt += 1
        found[seed] = None
    return list(found)


def cases_of(study: Study, request: Request = Request()) -> list[Case]:  # noqa: B008 - immutable
    """The cases in the order of the study. Raises StudyError naming the field of the study that cannot be used."""
    _check_secret(study, request)
    found: dict[str, Case] = {}
    for case in _cases(study, request):
        twin = found.setdefault(case.case_id, case)
        if twin is not case:
            raise StudyError(f"{study.name}: {case.label} and {twin.label} are the same examination: leave one of them out")
    if not found:
        raise StudyError(f"{study.name}: no patient in the split {request.split}: want populations.*.number.{request.split} >= 1")
    return list(found.values())


def secret_of(path: Path, study: Study) -> str:
    """What a file of secret seeds holds. Raises StudyError when it is not the one that the study wants."""
    try:
        content = path.read_bytes()
    except OSError as error:
        raise StudyError(f"--seeds-file {path}: {error.strerror}") from error
    digest = hashlib.sha256(content).hexdigest()
    if study.seeds_sha256 not in (None, digest):
        raise StudyError(f"--seeds-file {path}: its SHA-256 is {digest}; {study.name} wants {study.seeds_sha256}")
    if not content.strip():
        raise StudyError(f"--seeds-file {path}: is empty; want a secret of any kind, such as 32 random bytes")
    return content.hex()


def _check_secret(study: Study, request: Request) -> None:
    if study.seeds_sha256 is not None and request.split == "test" and request.secret is None:
        raise StudyError(f"{study.name}: seeds_sha256 = {study.seeds_sha256}: its split test needs that file, --seeds-file FILE")


def _cases(study: Study, request: Request) -> Iterator[Case]:
    salt = study.salt if request.secret is None else request.secret
    errors = study.error_levels()
    usable: dict[str, Scenario] = {}
    for name, population in study.populations.items():
        count = getattr(population.number, request.split)
        if count and request.number is not None:
            count = request.number
        for number, seed in enumerate(patient_seeds(study.name, name, request.split, count, salt)):
            for level, wrong in errors.items():
                for key, method in study.methods.items():
                    where = f"{study.name}: populations.{name} by methods.{key}"
                    scenario = _scenario(where, (population, method, wrong), (number, seed), request.settings)
                    if where not in usable:  # looking for what is installed takes a tenth of a second
                        usable[where] = _usable(where, scenario)
                    scenario = scenario.model_copy(update={"services": usable[where].services, "search": usable[where].search})
                    files = _files(scenario)
                    yield Case(
                        case_id=_case_id(scenario, files, study.tier, method),
                        population=name,
                        method=key,
                        errors=level or scenario.errors.level,
                        split=request.split,
                        number=number,
                        seed=seed,
                        tier=study.tier,
                        runtime=method.runtime,
                        periods=method.periods,
                        scenario=scenario.model_dump(mode="json"),
                        files=files,
                    )


def _scenario(
    where: str, parts: tuple[Population, Method, Errors | None], patient: tuple[int, int], settings: Sequence[str]
) -> Scenario:
    """The scenario of a patient, by number and seed."""
    population, method, wrong = parts
    number, seed = patient
    changes: dict[str, Any] = dict(population.settings)
    if population.lumps is not None:
        cells = population.lumps.cells()
        changes |= {f"phantom.draw.{field}": value for field, value in cells[number % len(cells)].items()}
    if wrong is not None:
        changes["errors"] = wrong.model_dump(mode="json")
    changes |= method.settings
    changes |= {f"services.{role}": name for role, name in method.services.items()}
    try:
        return load_scenario(population.scenario, [*as_settings(changes), *settings], seed)
    except ScenarioError as error:
        raise StudyError(f"{where}: {error}") from error


def _usable(where: str, scenario: Scenario) -> Scenario:
    """The scenario with files of services by their absolute path, after its phantom could be made and its services were found."""
    try:
        build_phantom(scenario.phantom, scenario.seed)
        return checked(scenario)
    except (PluginError, MeshError) as error:
        raise StudyError(f"{where}: {error}") from error


def _files(scenario: Scenario) -> dict[str, str]:
    """SHA-256 of the files that decide a result, by path."""
    named = [scenario.phantom.mesh, scenario.tissue.fmu, scenario.tissue.fmu_map]
    functions = (*scenario.services.model_dump().values(), scenario.exam.pattern, scenario.search.policy)
    named += [word for word in functions if is_file(word)]
    return {path: file_hash(path) for path in named if path is not None}


@cache
def file_hash(path: str) -> str:
    """SHA-256 of a file. Raises StudyError when it cannot be read."""
    try:
        return hashlib.sha256(Path(path).read_bytes()).hexdigest()
    except OSError as error:
        raise StudyError(f"{path}: {error.strerror}") from error


def _case_id(scenario: Scenario, files: Mapping[str, str], tier: Tier, method: Method) -> str:
    """The first digits of the SHA-256 over everything that decides the result, files by their content."""
    content = {
        "scenario": _by_content(scenario.model_dump(mode="json", exclude=set(MATTERS_NOT)), files),
        "tier": tier,
        "runtime": method.runtime,
        "periods": method.periods,
    }
    return hashlib.sha256(_canonical(content)).hexdigest()[:ID_DIGITS]


def _by_content(value: Any, files: Mapping[str, str]) -> Any:
    if isinstance(value, dict):
        return {key: _by_content(inner, files) for key, inner in value.items()}
    return files.get(value, value) if isinstance(value, str) else value


def _canonical(value: Any) -> bytes:
    return json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=False).encode()
