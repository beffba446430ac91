"""A case is examined in its own process: `python -m palpate.study.case [RUNS]`, a JSON line in for each case, a line out.

The results of whole examinations stay in the folder RUNS, if there is one, each in a folder with the name of its case.

A whole examination has its own process; quick ones share one that stays warm. It has one thread of BLAS and OpenMP, and ends
at once when the process that started it does, however that ended.
"""

from __future__ import annotations

import os
import queue
import resource
import shutil
import socket
import sys
import tempfile
from pathlib import Path
from threading import Thread
from time import perf_counter, process_time
from typing import IO, Final

from pydantic import BaseModel, ConfigDict

from palpate.report.page import write_page
from palpate.report.results import assemble, truth_of_run, write_results
from palpate.report.rows import Report
from palpate.run.composed import run_composed
from palpate.run.distributed import run_distributed
from palpate.study.code import code_digest
from palpate.study.manifest import Case, file_hash
from palpate_conductor.outcome import Timing
from palpate_models.scenario.schema import Scenario

KIB: Final = 1024
"""Linux gives `ru_maxrss` in this many bytes."""


class CaseError(Exception):
    """A case that cannot be examined here. Says why."""


class Attempt(BaseModel):
    """What one attempt at a case came to."""

    model_config = ConfigDict(frozen=True, use_attribute_docstrings=True)

    case_id: str
    report: Report | None
    why: str | None
    """Why there is no report that counts; null where there is."""
    code: str = ""
    peak_memory_bytes: int = 0
    wall_time_s: float = 0.0
    assess_time_s: float | None = None
    """What of that the assessment took."""
    core_s: float = 0.0
    host: str = ""
    loop_examinations: int | None = None
    """From how many whole examinations the errors of a quick case are; null of a whole one."""


def examine(case: Case, runs: Path | None = None) -> Attempt:
    """Examines a patient in this process; `runs`: where the results of a whole examination stay.

    Errors of the code are raised; a run that failed is in the report.
    """
    begin, used = perf_counter(), _core_s()
    for path, known in case.files.items():
        if file_hash(path) != known:
            raise CaseError(
                f"{path} is not the file that the study was made with: its SHA-256 begins with {file_hash(path)[:16]}"
            )
    scenario = Scenario.model_validate(case.scenario)
    quick = case.tier == "quick"
    report, assess_s = _quick(scenario) if quick else _whole(scenario, case, runs)
    return Attempt(
        case_id=case.case_id,
        report=report,
        why=report.failure if case.runtime == "wallclock" else None,  # simulated time would fail again in the same way
        code=code_digest(),
        peak_memory_bytes=_peak_memory(),
        wall_time_s=perf_counter() - begin,
        assess_time_s=assess_s,
        core_s=_core_s() - used,
        host=socket.gethostname(),
        loop_examinations=_behind_loop(scenario) if quick else None,
    )


def _whole(scenario: Scenario, case: Case, runs: Path | None) -> tuple[Report, float | None]:
    """The report, and the real time of the assessment [s] where it is known."""
    with tempfile.TemporaryDirectory(prefix="palpate-case-") as temporary:
        folder = Path(temporary) if runs is None else _emptied(runs / case.case_id)
        if case.runtime == "lockstep":
            result = run_composed(scenario, folder, lambda _: None, observers=())
        else:
            result = run_distributed(scenario, folder, lambda _: None, (), Timing(wallclock=True))
    if result.interrupted:
        raise CaseError("interrupted")
    blame = result.blame.get("assessment")
    if runs is None:
        report = assemble(scenario, result, truth_of_run(scenario, result.collected))
    else:
        report = write_results(folder, scenario, result)
        write_page(folder)
    return report, None if blame is None else blame["steps"] * blame["compute"] / 1e6


def _emptied(folder: Path) -> Path:
    """The folder, without what an earlier attempt left in it."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    return folder


def _quick(scenario: Scenario) -> tuple[Report, float]:
    from palpate.quick.case import run_quick  # noqa: PLC0415 - whole examinations need nothing of it

    quick = run_quick(scenario)
    return quick.report, quick.assess_s


def _behind_loop(scenario: Scenario) -> int:
    from palpate.quick.errors import loop_errors  # noqa: PLC0415 - whole examinations need nothing of it

    return loop_errors(scenario).examinations


def _core_s() -> float:
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return process_time() + children.ru_utime + children.ru_stime


def _peak_memory() -> int:
    """Largest memory so far of this process, and of the largest that it started [bytes]."""
    return KIB * sum(resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))


def _attempt(line: str, runs: Path | None) -> Attempt:
    case = Case.model_validate_json(line)
    try:
        return examine(case, runs)
    except Exception as error:  # whatever it is, it is this case's, and is told
        return Attempt(case_id=case.case_id, report=None, why=f"{type(error).__name__}: {error}", code=code_digest())


def _listen(lines: queue.Queue[str]) -> None:
    """Passes on what comes in; at its end the process that wanted results is gone."""
    for line in sys.stdin:
        lines.put(line)
    os._exit(0)


def serve(answers: IO[str], runs: Path | None) -> None:
    """Examines the cases that come in, one after another, until nothing more can come; `runs` as in `examine`."""
    lines: queue.Queue[str] = queue.Queue()
    Thread(target=_listen, args=(lines,), daemon=True).start()
    while True:
        answers.write(_attempt(lines.get(), runs).model_dump_json() + "\n")
        answers.flush()


if __name__ == "__main__":
    own = os.fdopen(os.dup(sys.stdout.fileno()), "w", encoding="utf-8")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # whatever a library prints is no answer
    serve(own, Path(sys.argv[1]) if len(sys.argv) > 1 else None)
