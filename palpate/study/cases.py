"""The cases of a study: every patient, with every entry of errors, by every method; the name of a case is a hash of its content.

A patient's seed is a hash of study, population, split, number and salt. It does not depend on method and errors, so that
comparisons are paired, nor on worker and order, so that every way to run the study examines the same patients.
"""

import ast
import hashlib
import json
import shlex
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from functools import cache
from itertools import count as count_from
from pathlib import Path
from typing import Any, Final, NamedTuple

from palpate.run.inputs import check_examinable
from palpate.study.shift import Family, shift_patient
from palpate.study.spec import Method, Population, Runtime, Split, Study, StudyError, Tier
from palpate_bus.recordings import recorded_files
from palpate_errors import UserError, restate
from palpate_models.robot.urdf_arm import arm_files
from palpate_models.scenario.errors import Errors
from palpate_models.scenario.load import as_settings, load_scenario
from palpate_models.scenario.schema import Scenario
from palpate_models.section import Section
from palpate_plugins import is_file

TUNE_SEEDS: Final = 1000
"""Seeds below this are for tuning only."""
MOST_SEEDS: Final = 2**31
YAML: Final = (".yaml", ".yml")
IRRELEVANT: Final = ("name", "description")
"""Fields of a scenario that do not change a result."""


class Case(Section):
    """One examination of one patient."""

    case_id: str
    population: str
    method: str
    errors: str
    """Name of the equipment errors in the study."""
    split: Split
    number: int
    """Index of the patient in the population."""
    seed: int
    tier: Tier
    runtime: Runtime
    periods: dict[str, int]
    scenario: dict[str, Any]
    """The complete scenario, with the drawn person."""
    files: dict[str, str]
    """SHA-256 of each file that the scenario names, by its path (`file_hash`)."""

    @property
    def label(self) -> str:
        """Population, number, method and errors, for messages."""
        return " ".join(filter(None, (self.population, str(self.number), self.method, self.errors)))

    @property
    def content_id(self) -> str:
        """The id that belongs to its content."""
        return content_id(self.scenario, self.files, self.tier, self.runtime, self.periods)


class Request(NamedTuple):
    """The requested part of a study and its changes."""

    split: Split = "test"
    number: int | None = None
    """Patients of each population that is not empty; None for the study's numbers."""
    settings: Sequence[str] = ()
    """Overrides `a.b=c` of every scenario, applied last."""
    secret: str | None = None
    """Content of the file of secret seeds, which replaces the study's salt, except in the split `tune`."""


def command_of(name: str, request: Request, methods: Sequence[str] = (), services: Sequence[str] = ()) -> str:
    """Return the command that runs a study again, by its name or file, with FILE for the file of secret seeds."""
    options: dict[str, Sequence[str]] = {
        "--split": [request.split],
        "--number": [] if request.number is None else [str(request.number)],
        "--method": methods,
        "--service": services,
        "--set": request.settings,
        "--seeds-file": [] if request.secret is None else ["FILE"],
    }
    arguments = [argument for option, values in options.items() for value in values for argument in (option, value)]
    return shlex.join(["palpate", "study", name, *arguments])


def patient_seeds(study: str, population: str, split: Split, count: int, salt: str) -> list[int]:
    """Return the distinct seeds of the first patients of a population: 0 to 999 for tuning, others for the other splits.

    The first seeds do not depend on `count`. Raises StudyError if there are not as many.
    """
    first, room = (0, TUNE_SEEDS) if split == "tune" else (TUNE_SEEDS, MOST_SEEDS - TUNE_SEEDS)
    if count > room:
        raise StudyError(f"{study}: populations.{population}: {count} patients in split {split}, expected at most {room}")
    found: dict[int, None] = {}
    for number in range(count):
        for attempt in count_from(0):
            words = [study, population, split, number, "" if split == "tune" else salt, *([attempt] if attempt else [])]
            seed = first + int.from_bytes(hashlib.sha256(canonical(words)).digest()[:8], "big") % room
            if seed not in found:
                found[seed] = None
                break
    return list(found)


def cases_of(study: Study, request: Request = Request()) -> list[Case]:  # noqa: B008 - immutable
    """Return the cases in the order of the study. Raises StudyError that names the invalid field of the study."""
    if study.seeds_sha256 is not None and request.split != "tune" and request.secret is None:
        needed = f"the split {request.split} needs the file of that hash, --seeds-file FILE"
        raise StudyError(f"{study.name}: seeds_sha256 = {study.seeds_sha256}: {needed}")
    found: dict[str, Case] = {}
    for case in _cases(study, request):
        twin = found.setdefault(case.case_id, case)
        if twin is not case:
            raise StudyError(f"{study.name}: {case.label} and {twin.label} are the same examination: remove one of them")
    if not found:
        raise StudyError(f"{study.name}: no patient in split {request.split}: expected populations.*.number.{request.split} >= 1")
    return list(found.values())


def secret_of(path: Path, study: Study) -> str:
    """Return the content of a file of secret seeds. Raises StudyError if it is not the file of the study."""
    with restate(OSError, StudyError, f"--seeds-file {path}"):
        content = path.read_bytes()
    digest = hashlib.sha256(content).hexdigest()
    if study.seeds_sha256 not in (None, digest):
        raise StudyError(f"--seeds-file {path}: its SHA-256 is {digest}; {study.name} expects {study.seeds_sha256}")
    if not content.strip():
        raise StudyError(f"--seeds-file {path}: is empty; expected a secret of any kind, such as 32 random bytes")
    return content.hex()


def _cases(study: Study, request: Request) -> Iterator[Case]:
    salt = study.salt if request.secret is None else request.secret
    errors = study.error_levels()
    usable: dict[str, Scenario] = {}
    for name, family, population, planned in _populations(study, request.split):
        count = request.number if planned and request.number is not None else planned
        for number, seed in enumerate(patient_seeds(study.name, name, request.split, count, salt)):
            for level, wrong in errors.items():
                for key, method in study.methods.items():
                    where = f"{study.name}: populations.{name} by methods.{key}"
                    scenario = _scenario(where, (population, method, wrong), (number, seed), request.settings, family)
                    if where not in usable:  # the search for installed services takes 0.1 s
                        usable[where] = _check_usable(where, scenario)
                    scenario = scenario.model_copy(update={"services": usable[where].services, "search": usable[where].search})
                    files, content = _files(scenario), scenario.model_dump(mode="json")
                    yield Case(
                        case_id=content_id(content, files, study.tier, method.runtime, method.periods),
                        population=name,
                        method=key,
                        errors=level or scenario.errors.level,
                        split=request.split,
                        number=number,
                        seed=seed,
                        tier=study.tier,
                        runtime=method.runtime,
                        periods=method.periods,
                        scenario=content,
                        files=files,
                    )


def _populations(study: Study, split: Split) -> Iterator[tuple[str, Family | None, Population, int]]:
    """Yield name, family, population and number of patients; in the split `shift` each family of a population is one."""
    for name, population in study.populations.items():
        if split == "shift":
            yield from ((f"{name}-{family}", family, population, count) for family, count in population.number.shift.items())
        else:
            yield name, None, population, getattr(population.number, split)


def _scenario(
    where: str,
    parts: tuple[Population, Method, Errors | None],
    patient: tuple[int, int],
    settings: Sequence[str],
    family: Family | None = None,
) -> Scenario:
    """Return the scenario of a patient, given by number and seed, changed as the family says."""
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
    with restate(UserError, StudyError, where):
        if family is not None:
            changes |= shift_patient(load_scenario(population.scenario, as_settings(changes), seed), family, number)
        return load_scenario(population.scenario, [*as_settings(changes), *settings], seed)


def _check_usable(where: str, scenario: Scenario) -> Scenario:
    """Return the scenario with absolute paths of services, after everything was checked that `palpate run` checks."""
    with restate(UserError, StudyError, where):
        return check_examinable(scenario)


def _files(scenario: Scenario) -> dict[str, str]:
    """Return the SHA-256 of each file that a result depends on, by path."""
    phantom, tissue, robot = scenario.phantom, scenario.tissue, scenario.robot
    chosen = (*scenario.services.model_dump().values(), scenario.exam.pattern, scenario.search.policy, robot.arm)
    named = [word for word in (*chosen, robot.driver.profile or "") if is_file(word) or word.endswith(YAML)]
    given = (phantom.mesh, phantom.grid, tissue.fmu, tissue.fmu_map, scenario.camera.recording, *named)
    return {path: file_hash(path) for path in given if path is not None}


@cache
def file_hash(path: str) -> str:
    """Return the SHA-256 of a file with what belongs to it: the modules of its folder that a Python file imports, URDF and
    meshes of an arm; of a folder, that of its recording.

    Raises StudyError if a file cannot be read.
    """
    with restate((OSError, UserError), StudyError, path):
        own, *imported = [_digest(file) for file in _sources(Path(path))]
    return hashlib.sha256(canonical([own, *imported])).hexdigest() if imported else own


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _sources(path: Path) -> list[Path]:
    """Return the files of a folder's recording, or of an arm; else a file and, if it is Python, the modules of its folder that
    it imports, and that these import.
    """
    if path.is_dir():
        return list(recorded_files(path)[1])
    if path.name.endswith(YAML):
        with suppress(UserError):  # another YAML file than that of an arm
            return arm_files(str(path))
    found = [path]
    for file in found:
        for name in _imported(file.read_text(encoding="utf-8", errors="replace")) if is_file(file.name) else ():
            near = path.parent / name
            module = near.with_suffix(".py")
            found += [new for new in ([module] if module.is_file() else sorted(near.rglob("*.py"))) if new not in found]
    return found


def _imported(text: str) -> list[str]:
    """Return the top-level names of the modules that a Python file imports, also in its functions; none if it is not Python."""
    try:
        nodes = list(ast.walk(ast.parse(text)))
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        return []
    names = {alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names}
    names |= {node.module for node in nodes if isinstance(node, ast.ImportFrom) and node.module and not node.level}
    return sorted({name.partition(".")[0] for name in names})


def content_id(
    scenario: Mapping[str, Any], files: Mapping[str, str], tier: Tier, runtime: Runtime, periods: Mapping[str, int]
) -> str:
    """Return the first digits of the SHA-256 over everything that the result depends on, files by their content."""
    content = {
        "scenario": _by_content({key: value for key, value in scenario.items() if key not in IRRELEVANT}, files),
        "tier": tier,
        "runtime": runtime,
        "periods": periods,
    }
    return hashlib.sha256(canonical(content)).hexdigest()[:16]


def _by_content(value: Any, files: Mapping[str, str]) -> Any:
    if isinstance(value, dict):
        return {key: _by_content(inner, files) for key, inner in value.items()}
    return files.get(value, value) if isinstance(value, str) else value


def canonical(value: Any) -> bytes:
    """Return JSON that does not depend on the order of keys."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=False).encode()
