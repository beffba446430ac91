"""A study is run: every case that has no outcome yet is given to the workers, and what comes back is kept on the disk.

The folder of a study is all that there is of it: whenever the run is stopped, and however, the next one goes on from there.

    study.json, study.html     figures and page (`palpate.study.summary`)
    run.json                   what was run, where, with which code, and the digest
    manifest.json              all cases, without their scenarios
    cases/ID.json              the outcome of a case
    failures/ID.json           why earlier attempts at a case failed
    cases.parquet, findings.parquet, lumps.parquet
    sessions.jsonl             how long each go at it took
    real_time.md               with examinations by the wall clock: how late they were
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from pathlib import Path
from typing import Final

from palpate.report.files import write_text
from palpate.study.case import Attempt
from palpate.study.child import run_batch
from palpate.study.code import code_digest
from palpate.study.folder import FAILURES, Manifest, manifest_of, open_folder
from palpate.study.manifest import Case
from palpate.study.outcome import ATTEMPTS, Outcome, case_file, read_outcome, write_outcome
from palpate.study.spec import StudyError
from palpate.study.workers import Workers
from palpate_errors import RunError

BATCH: Final = {"whole": 1, "quick": 8}
"""Most cases a task ..."""
SHARE: Final = 4
"""... and so many tasks a worker at least, so that none waits for another at the end."""
LOOK_S: Final = 2.0
"""How often it is looked whether the workers are still there."""
Tell = Callable[[Outcome], None]
"""Hears of every case that has an outcome now."""


class StudyStopped(RunError):
    """The workers are gone, or cannot work. What was done is kept. Says why."""


def missing(folder: Path, cases: Iterable[Case]) -> list[Case]:
    """The cases that have no outcome in the folder yet."""
    return [case for case in cases if not case_file(folder, case.case_id).is_file()]


def of_other_code(folder: Path, cases: Iterable[Case]) -> list[Case]:
    """The cases whose outcome in the folder was made by other code than this."""
    found = ((case, read_outcome(folder, case.case_id)) for case in cases)
    return [case for case, outcome in found if outcome is not None and outcome.code not in ("", code_digest())]


def opened(folder: Path, study: str, cases: Sequence[Case], command: str, keep: bool = False) -> Manifest:
    """Makes the folder of a study of these cases, which `command` runs again, or goes on in it. Returns its manifest.

    `keep`: cases that other code has made count. Raises StudyError for them otherwise, and for a folder of another study.
    """
    if not keep and (old := of_other_code(folder, cases)):
        raise StudyError(
            f"{folder}: {len(old)} of its cases were made by other code: give another folder with -o, or --keep them"
        )
    manifest = manifest_of(study, cases, command)
    open_folder(folder, manifest)
    return manifest


def run_cases(folder: Path, cases: Sequence[Case], workers: Workers, tell: Tell, *, runs: bool = False) -> None:
    """Examines all cases that have no outcome yet, in any order. Raises StudyStopped.

    `runs`: the results of whole examinations stay in the folder `runs`, each in a folder of its own.
    """
    (folder / "cases").mkdir(parents=True, exist_ok=True)
    (folder / FAILURES).mkdir(exist_ok=True)
    todo, kept = missing(folder, cases), str((folder / "runs").resolve()) if runs else None
    running: dict[Future[list[str]], list[Case]] = {}

    def submit(batch: list[Case]) -> None:
        lines = [case.model_dump_json() for case in batch]
        running[workers.executor.submit(run_batch, lines, kept)] = batch

    size = max(1, min(BATCH[todo[0].tier], len(todo) // (SHARE * workers.count))) if todo else 1
    for first in range(0, len(todo), size):
        submit(todo[first : first + size])
    while running:
        finished, _ = wait(running, timeout=LOOK_S, return_when=FIRST_COMPLETED)
        if not finished and not workers.alive():
            raise StudyStopped("the scheduler is gone")
        for future in finished:
            batch = running.pop(future)
            for case, attempt in zip(batch, _attempts(future, batch, workers), strict=True):
                outcome = _outcome(folder, case, attempt)
                if outcome is None:
                    submit([case])
                else:
                    write_outcome(folder, outcome)
                    tell(outcome)


def _attempts(future: Future[list[str]], batch: Sequence[Case], workers: Workers) -> list[Attempt]:
    """What came of a batch. A worker that is lost again and again has lost it because of a case of the batch."""
    if future.cancelled():
        raise StudyStopped("the scheduler is gone")
    error = future.exception()
    if error is None:
        return [Attempt.model_validate_json(text) for text in future.result()]
    if isinstance(error, workers.killers):
        return [Attempt(case_id=case.case_id, report=None, why=f"its workers were lost: {error}") for case in batch]
    raise StudyStopped(f"a worker cannot examine: {type(error).__name__}: {error}") from error


def _outcome(folder: Path, case: Case, attempt: Attempt) -> Outcome | None:
    """The outcome of a case after another attempt; None when it is to be tried again."""
    before = failures(folder, case)
    if attempt.why is not None:
        before.append(attempt.why)
        write_text(_failures_file(folder, case), json.dumps(before) + "\n")
        if len(before) < ATTEMPTS:
            return None
    report = attempt.report
    return Outcome(
        case=case,
        status="done" if attempt.why is None else "failed",
        attempts=len(before) + (attempt.why is None),
        why=attempt.why if report is None else report.failure,
        **attempt.model_dump(exclude={"case_id", "why", "report"}),
        report=report,
    )


def failures(folder: Path, case: Case) -> list[str]:
    """Why earlier attempts at a case failed."""
    path = _failures_file(folder, case)
    return list(json.loads(path.read_text(encoding="utf-8"))) if path.is_file() else []


def _failures_file(folder: Path, case: Case) -> Path:
    return folder / FAILURES / f"{case.case_id}.json"
