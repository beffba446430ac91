"""The folder of a study: which cases it is to hold, and what is made of them once it holds them all."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final

from pydantic import BaseModel, ConfigDict, ValidationError

from palpate.report.files import write_text
from palpate.study.digest import RunRecord, Session, record, write_record
from palpate.study.manifest import Case
from palpate.study.outcome import Outcome, read_outcome
from palpate.study.real_time import write_real_time
from palpate.study.spec import StudyError
from palpate.study.summary import summarise
from palpate.study.tables import write_tables

MANIFEST: Final = "manifest.json"
SESSIONS: Final = "sessions.jsonl"
FAILURES: Final = "failures"


def usual_folder(study: str, split: str) -> Path:
    """Where the results of a study go unless it is said where."""
    return Path("out") / "study" / f"{study}-{split}"


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
    """That runs the study again; empty where there is none."""


def manifest_of(study: str, cases: Sequence[Case], command: str = "") -> Manifest:
    """The manifest of these cases."""
    rows = [ManifestRow.model_validate(case.model_dump()) for case in cases]
    return Manifest(study=study, split=cases[0].split, tier=cases[0].tier, cases=rows, command=command)


def read_manifest(folder: Path) -> Manifest | None:
    """What the folder holds; None when it holds nothing. Raises StudyError."""
    path = folder / MANIFEST
    try:
        return Manifest.model_validate_json(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return None
    except (OSError, ValidationError) as error:
        raise StudyError(f"{path} cannot be read: {error}") from error


def open_folder(folder: Path, manifest: Manifest) -> None:
    """Makes the folder, or goes on in one of the same study, split and settings. Raises StudyError for another's."""
    there = read_manifest(folder)
    if there is not None and (there.study, there.split) != (manifest.study, manifest.split):
        raise StudyError(f"{folder} holds {there.study}, split {there.split}: give {manifest.study} another folder with -o")
    if there is not None and {row.case_id for row in there.cases}.isdisjoint(row.case_id for row in manifest.cases):
        raise StudyError(f"{folder} holds {there.study} with other settings or patients: give this one another folder with -o")
    folder.mkdir(parents=True, exist_ok=True)
    write_text(folder / MANIFEST, manifest.model_dump_json(indent=1) + "\n")


def add_session(folder: Path, session: Session) -> None:
    """Keeps how long a go at the study took."""
    with (folder / SESSIONS).open("a", encoding="utf-8") as file:
        file.write(session.model_dump_json() + "\n")


def sessions(folder: Path) -> list[Session]:
    """All goes at the study."""
    path = folder / SESSIONS
    lines = path.read_text(encoding="utf-8").splitlines() if path.is_file() else []
    return [Session.model_validate_json(line) for line in lines]


def put_together(parts: Sequence[Path], folder: Path) -> None:
    """Takes over how long each go at a part took, each once however often this is done, and why attempts at cases failed."""
    every = dict.fromkeys(session for part in (folder, *parts) for session in sessions(part))
    write_text(folder / SESSIONS, "".join(f"{session.model_dump_json()}\n" for session in every))
    (folder / FAILURES).mkdir(exist_ok=True)
    for path in (path for part in parts for path in (part / FAILURES).glob("*.json")):
        write_text(folder / FAILURES / path.name, path.read_text(encoding="utf-8"))


def outcomes_of(folder: Path, manifest: Manifest) -> list[Outcome]:
    """The outcomes that there are, in the order of the manifest. Raises StudyError for a file that is none."""
    found = (read_outcome(folder, row.case_id) for row in manifest.cases)
    return [outcome for outcome in found if outcome is not None]


def conclude(folder: Path, manifest: Manifest) -> tuple[RunRecord, list[Outcome]]:
    """Writes tables, run.json, study.json and study.html of a study all of whose cases have an outcome."""
    outcomes = outcomes_of(folder, manifest)
    if len(outcomes) < len(manifest.cases):
        raise StudyError(f"{folder}: {len(manifest.cases) - len(outcomes)} of {len(manifest.cases)} cases have no outcome yet")
    write_tables(folder, manifest.study, outcomes)
    found = record(manifest.study, outcomes, sessions(folder))
    write_record(folder, found)
    write_real_time(folder, outcomes)
    summarise(folder, manifest.command)
    return found, outcomes
