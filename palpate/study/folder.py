"""The folder of a study: everything that a study has computed. A run that stops, for any reason, continues from it.

study.json, study.html     figures and page (`palpate.study.summary`)
run.json                   what was run, where, with which code, and the digest
manifest.json              all cases, without their scenarios
cases/ID.json              the outcome of a case
cases.parquet, findings.parquet, lumps.parquet
sessions.jsonl             duration of each call of the command
real_time.md               lateness in wall-clock mode
"""

import hashlib
import json
from collections.abc import Iterable, Iterator, Sequence
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final, Literal

from pydantic import BaseModel, ConfigDict, ValidationError

from palpate.report.files import write_text
from palpate.report.rows import Report
from palpate.run.roles import OBSERVERS, ROLES
from palpate.study.cases import Case, canonical
from palpate.study.spec import StudyError

MANIFEST: Final = "manifest.json"
SESSIONS: Final = "sessions.jsonl"
RUN: Final = "run.json"
ATTEMPTS: Final = 3
"""A case that fails this often is reported as failed."""
NO_DIGEST: Final = "examinations in wall-clock mode depend on the machine and its load, so they have no digest"
PACKAGES: Final = (
    "palpate.quick", "palpate.run", "palpate.truth", "palpate.report", "palpate_bus", "palpate_models", "palpate_conductor",
    "palpate_fmu", *(f"palpate_{role}" for role in ROLES if role not in OBSERVERS),
)  # fmt: skip
"""Packages whose code decides results."""
HASH: Final = "sha256"
"""Field of an outcome's file: SHA-256 over the other fields."""
SUFFIXES: Final = (".py", ".yaml", ".csv", ".npz", ".c", ".h")


class ManifestRow(BaseModel):
    """A case, without its scenario."""

    model_config = ConfigDict(frozen=True, extra="ignore")

    case_id: str
    population: str
    method: str
    errors: str
    number: int
    seed: int


class Manifest(BaseModel):
    """manifest.json: all cases of a study, in its order."""

    model_config = ConfigDict(frozen=True, use_attribute_docstrings=True)

    study: str
    split: str
    tier: str
    cases: list[ManifestRow]
    command: str = ""
    """Runs the study again; may be empty."""


class Attempt(BaseModel):
    """The result of one attempt at a case."""

    model_config = ConfigDict(frozen=True, use_attribute_docstrings=True)

    report: Report | None = None
    why: str | None
    """Reason for a missing or invalid report, or why the examination was aborted; null for a completed one."""
    code: str = ""
    """SHA-256 over the code that made the result (`code_digest`)."""
    peak_memory_bytes: int = 0
    """Peak memory of the process that ran the case."""
    wall_time_s: float = 0.0
    """From the start of the case to its report."""
    assess_time_s: float | None = None
    """Part of it that the assessment took."""
    core_s: float = 0.0
    """Processor time."""
    loop_examinations: int | None = None
    """Number of whole examinations that the error model of a quick case was fitted to; null for a whole one."""


class Outcome(Attempt):
    """cases/ID.json: the last attempt at a case."""

    case: Case
    status: Literal["done", "failed"]
    """`failed`: no report after three attempts. An examination that was aborted is done, and not completed."""
    attempts: int
    failures: list[str] = []
    """Causes of its failed attempts."""

    @property
    def completed(self) -> bool:
        """True if the examination was finished and assessed."""
        return self.report is not None and self.report.failure is None and self.report.assessed


class Session(BaseModel):
    """One call of the command, to its end or until it was stopped."""

    model_config = ConfigDict(frozen=True)

    workers: int
    cases: int
    elapsed_s: float


class RunRecord(BaseModel):
    """run.json."""

    model_config = ConfigDict(frozen=True, use_attribute_docstrings=True)

    study: str
    split: str
    cases: int
    done: int
    failed: int
    """Cases without a report after three attempts."""
    not_completed: int
    """Examinations that were not finished, including failed cases."""
    digest: str | None
    """SHA-256 over the sorted pairs of case and run hash; null in wall-clock mode."""
    no_digest: str | None
    """Reason for a missing digest."""
    code: list[str]
    """SHA-256 of each version of the code that made cases. With more than one, figures mix versions."""
    platforms: list[dict[str, Any]]
    """Machines; equal digests are promised on equal platforms only."""
    peak_memory_bytes: int
    """Largest of all cases."""
    wall_time_s: float
    core_s: float
    """Sum over the cases."""
    sessions: list[Session]


class Folder:
    """A study's folder on the disk."""

    def __init__(self, path: Path) -> None:
        """Refer to a folder, which need not exist."""
        self.path = path

    def open(self, manifest: Manifest) -> None:
        """Create the folder, or reuse one of the same study, split and settings. Raises StudyError for any other."""
        old = self.manifest()
        if old is not None and (old.study, old.split) != (manifest.study, manifest.split):
            raise StudyError(f"{self.path} holds {old.study}, split {old.split}: give {manifest.study} another folder with -o")
        if old is not None and {row.case_id for row in old.cases}.isdisjoint(row.case_id for row in manifest.cases):
            raise StudyError(f"{self.path} holds {old.study} with other settings or patients: give another folder with -o")
        (self.path / "cases").mkdir(parents=True, exist_ok=True)
        write_text(self.path / MANIFEST, manifest.model_dump_json(indent=1) + "\n")

    def manifest(self) -> Manifest | None:
        """Return the manifest, or None for a folder without one. Raises StudyError for one that cannot be read."""
        path = self.path / MANIFEST
        try:
            return Manifest.model_validate_json(path.read_text(encoding="utf-8"))
        except FileNotFoundError:
            return None
        except (OSError, ValidationError) as error:
            raise StudyError(f"{path} cannot be read: {error}") from error

    def case_file(self, case_id: str) -> Path:
        """Return the path of a case's outcome."""
        return self.path / "cases" / f"{case_id}.json"

    def write(self, outcome: Outcome) -> None:
        """Write the outcome of a case with the hash of its content, atomically."""
        content = json.loads(outcome.model_dump_json())
        write_text(self.case_file(outcome.case.case_id), json.dumps(content | {HASH: _hash(content)}) + "\n")

    def outcome(self, case_id: str) -> Outcome | None:
        """Return the outcome of a case, or None if it has none yet.

        Raises StudyError for a file that cannot be read, that was changed, or that has another case.
        """
        path = self.case_file(case_id)
        try:
            content = json.loads(path.read_text(encoding="utf-8"))
            known = content.pop(HASH, None) if isinstance(content, dict) else None
            outcome = Outcome.model_validate(content)
            if known != _hash(content):
                raise ValueError(f"{HASH} is {known!r}, not the hash of its content: the file was changed")
            if not case_id == outcome.case.case_id == outcome.case.content_id:
                raise ValueError(f"it has the case {outcome.case.case_id}, whose content has the id {outcome.case.content_id}")
            if outcome.status == "done" and not outcome.code:
                raise ValueError("code is empty: expected the SHA-256 of the code that made it")
        except FileNotFoundError:
            return None
        except (OSError, ValueError, RecursionError) as error:
            raise StudyError(f"{path} is not an outcome of this version ({error}): remove it to run its case again") from error
        return outcome

    def outcomes(self, manifest: Manifest) -> list[Outcome]:
        """Return the outcomes that exist, in the order of the manifest. Raises StudyError for an unreadable file."""
        found = (self.outcome(row.case_id) for row in manifest.cases)
        return [outcome for outcome in found if outcome is not None]

    def missing(self, cases: Iterable[Case]) -> list[Case]:
        """Return the cases without an outcome."""
        return [case for case in cases if not self.case_file(case.case_id).is_file()]

    def of_other_code(self, cases: Iterable[Case]) -> list[Case]:
        """Return the cases whose outcome was made by another version of the code."""
        found = ((case, self.outcome(case.case_id)) for case in cases)
        return [case for case, outcome in found if outcome is not None and outcome.code not in ("", code_digest())]

    def sessions(self) -> list[Session]:
        """Return all calls of the command, without a last one whose line a kill or a full disk cut.

        Raises StudyError for any other line that cannot be read.
        """
        path = self.path / SESSIONS
        lines = path.read_text(encoding="utf-8", errors="replace").splitlines() if path.is_file() else []
        found = []
        for number, line in enumerate(lines, start=1):
            try:
                found.append(Session.model_validate_json(line))
            except ValueError as error:
                if number < len(lines):
                    raise StudyError(f"{path}, line {number} is not a session ({error}): remove it") from error
        return found

    def write_sessions(self, sessions: Iterable[Session]) -> None:
        """Write all calls of the command, atomically."""
        write_text(self.path / SESSIONS, "".join(f"{session.model_dump_json()}\n" for session in sessions))


def _hash(content: Any) -> str:
    return hashlib.sha256(canonical(content)).hexdigest()


def default_folder(study: str, split: str) -> Path:
    """Return the folder of a study for which no other is given."""
    return Path("out") / "study" / f"{study}-{split}"


def manifest_of(study: str, cases: Sequence[Case], command: str = "") -> Manifest:
    """Return the manifest of cases."""
    rows = [ManifestRow.model_validate(case.model_dump()) for case in cases]
    return Manifest(study=study, split=cases[0].split, tier=cases[0].tier, cases=rows, command=command)


def open_folder(path: Path, study: str, cases: Sequence[Case], command: str, keep: bool = False) -> tuple[Folder, Manifest]:
    """Create or reopen the folder of a study of these cases, which `command` runs again.

    Raises StudyError for the folder of another study and, unless `keep`, for cases of another version of the code.
    """
    folder = Folder(path)
    if not keep and (old := folder.of_other_code(cases)):
        raise StudyError(f"{path}: {len(old)} of its cases were made by other code: give another folder with -o, or --keep them")
    manifest = manifest_of(study, cases, command)
    folder.open(manifest)
    return folder, manifest


def merge(parts: Sequence[Path], path: Path) -> tuple[Folder, Manifest]:
    """Merge the parts of one study into a folder; repeated merges change nothing. All is read and checked before any is written.

    Raises StudyError if the parts are not of one study, or if a case has no outcome in any of them.
    """
    manifests = []
    for part in parts:
        manifest = Folder(part).manifest()
        if manifest is None:
            raise StudyError(f"{part} is not the folder of a study: it has no manifest.json")
        manifests.append(manifest)
    first = manifests[0]
    for part, other in zip(parts, manifests, strict=True):
        if (other.study, other.cases) != (first.study, first.cases):
            raise StudyError(f"{part} holds another study, split or number of patients than {parts[0]}")
    folder, places = Folder(path), [Folder(place) for place in (path, *parts)]
    outcomes = {outcome.case.case_id: outcome for place in places for outcome in place.outcomes(first)}
    sessions = dict.fromkeys(session for place in places for session in place.sessions())
    absent = [row.case_id for row in first.cases if row.case_id not in outcomes]
    if absent:
        raise StudyError(f"{len(absent)} of {len(first.cases)} cases are in no part, {absent[0]} the first: run what is missing")
    folder.open(first)
    folder.write_sessions(sessions)
    for outcome in outcomes.values():
        folder.write(outcome)
    return folder, first


def digest(outcomes: Iterable[Outcome]) -> str:
    """Return the SHA-256 over the sorted pairs of case and run hash; a case without a hash counts by its reason."""
    pairs = sorted((one.case.case_id, (one.report and one.report.run_hash) or f"without: {one.why}") for one in outcomes)
    return hashlib.sha256(json.dumps(pairs).encode()).hexdigest()


def record(study: str, outcomes: Sequence[Outcome], sessions: Sequence[Session]) -> RunRecord:
    """Return the record of a finished study."""
    wallclock = any(outcome.case.runtime == "wallclock" for outcome in outcomes)
    platforms = {json.dumps(one.report.platform, sort_keys=True): one.report.platform for one in outcomes if one.report}
    return RunRecord(
        study=study,
        split=outcomes[0].case.split,
        cases=len(outcomes),
        done=sum(outcome.status == "done" for outcome in outcomes),
        failed=sum(outcome.status == "failed" for outcome in outcomes),
        not_completed=sum(not outcome.completed for outcome in outcomes),
        digest=None if wallclock else digest(outcomes),
        no_digest=NO_DIGEST if wallclock else None,
        code=sorted({outcome.code for outcome in outcomes if outcome.code}),
        platforms=[platforms[key] for key in sorted(platforms)],
        peak_memory_bytes=max(outcome.peak_memory_bytes for outcome in outcomes),
        wall_time_s=sum(outcome.wall_time_s for outcome in outcomes),
        core_s=sum(outcome.core_s for outcome in outcomes),
        sessions=list(sessions),
    )


@cache
def code_digest() -> str:
    """Return the SHA-256 over the files that decide results, by their path in the package, however they are installed."""
    found = hashlib.sha256()
    for name, path in sorted(_code_files()):
        found.update(f"{name}\0{hashlib.sha256(path.read_bytes()).hexdigest()}\0".encode())
    return found.hexdigest()


def _code_files() -> Iterator[tuple[str, Path]]:
    for package in PACKAGES:
        spec = find_spec(package)
        for root in map(Path, (spec.submodule_search_locations if spec else None) or ()):
            for path in root.rglob("*"):
                if path.suffix in SUFFIXES:
                    yield f"{package}/{path.relative_to(root).as_posix()}", path
            if package == "palpate_fmu":  # in a checkout the C sources are next to the package
                for path in (root.parent / "src").glob("*.[ch]"):
                    yield f"{package}/src/{path.name}", path
