"""Examines cases in a process of its own: `python -m palpate.study.case [RUNS]` reads a case and prints an attempt per line.

The process has a fixed environment (one thread of BLAS and OpenMP, fixed hash seed), so that results do not depend on the worker.
It ends when the worker that started it ends. Results of whole examinations stay in RUNS/CASE_ID if RUNS is given.
"""

import os
import resource
import shutil
import socket
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from threading import Thread
from time import perf_counter, process_time, sleep
from typing import Final

from palpate.environment import FIXED
from palpate.report.page import write_page
from palpate.report.results import assemble, truth_of_run, write_results
from palpate.report.rows import Report
from palpate.run.composed import run_composed
from palpate.run.distributed import run_distributed
from palpate.study.cases import Case, file_hash
from palpate.study.folder import Attempt, code_digest
from palpate_bus.settings import variable
from palpate_conductor.outcome import Timing
from palpate_errors import RunError
from palpate_models.scenario.schema import Scenario

LIMIT_S: Final = {"whole": 3600.0, "quick": 300.0}
"""Time limit of a case; one that takes longer counts as hung."""
KEEP_MEMORY: Final = {"MALLOC_TRIM_THRESHOLD_": str(1 << 30), "MALLOC_MMAP_THRESHOLD_": str(1 << 25)}
"""Makes glibc's malloc keep freed memory for the next arrays; page faults would cost a tenth of a quick case."""
KIB: Final = 1024
"""Unit of `ru_maxrss` on Linux."""


def run_batch(batch: Sequence[str], runs: str | None = None) -> list[str]:
    """Examine cases, given as JSON, one after another in one process; the task of a Dask worker.

    Returns the attempts as JSON, in order. Fewer than there are cases if the process ended early: the last one is then the
    failure of the case that it was busy with. `runs`: folder on the worker for the results of whole examinations.
    """
    cases = [Case.model_validate_json(text) for text in batch]
    periods = ",".join(f"{role}={period}" for role, period in cases[0].periods.items())
    environment = {**os.environ, **FIXED, **KEEP_MEMORY, **({variable("periods"): periods} if periods else {})}
    limit_s = LIMIT_S[cases[0].tier] * len(cases)
    command = [sys.executable, "-m", "palpate.study.case", *([] if runs is None else [runs])]
    with tempfile.TemporaryFile("w+", encoding="utf-8", errors="replace") as log:
        try:
            done = subprocess.run(
                command,
                input="\n".join(batch) + "\n",
                stdout=subprocess.PIPE,
                stderr=log,
                text=True,
                env=environment,
                timeout=limit_s,
                start_new_session=True,  # Ctrl-C goes to the study, which ends its processes
                check=False,
            )
            output, why = done.stdout, f"its process ended with status {done.returncode}"
        except subprocess.TimeoutExpired as error:
            partial = error.stdout or b""
            output = partial.decode() if isinstance(partial, bytes) else partial
            why = f"took longer than {limit_s:.0f} s"
        log.seek(0)
        lines = log.read().strip().splitlines()
    attempts = [line for line in output.splitlines(keepends=True) if line.endswith("\n")]
    if len(attempts) < len(cases):
        cause = f"{why}: {lines[-1]}" if lines else why
        attempts.append(Attempt(why=cause).model_dump_json())
    return attempts


def examine(case: Case, runs: Path | None = None) -> Attempt:
    """Examine a patient in this process. A failed run is part of the report; errors of the code are raised."""
    begin, used = perf_counter(), _core_s()
    for path, known in case.files.items():
        if file_hash(path) != known:
            raise RunError(f"{path} is not the file that the study was made with: its SHA-256 begins with {file_hash(path)[:16]}")
    scenario = Scenario.model_validate(case.scenario)
    examinations: int | None = None
    assess_s: float | None
    if case.tier == "quick":
        from palpate.quick.case import run_quick  # noqa: PLC0415 - whole examinations do not need it
        from palpate.quick.errors import loop_errors  # noqa: PLC0415

        quick = run_quick(scenario)
        report, assess_s = quick.report, quick.assess_s
        examinations = loop_errors(scenario).examinations
    else:
        report, assess_s = _whole(scenario, case, runs)
    # a composed run is forked and shares memory
    peaks = [resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return Attempt(
        report=report,
        why=report.failure if case.runtime == "wallclock" else None,  # in simulated time it would fail again in the same way
        code=code_digest(),
        peak_memory_bytes=KIB * (max(peaks) if case.runtime == "lockstep" else sum(peaks)),
        wall_time_s=perf_counter() - begin,
        assess_time_s=assess_s,
        core_s=_core_s() - used,
        host=socket.gethostname(),
        loop_examinations=examinations,
    )


def _whole(scenario: Scenario, case: Case, runs: Path | None) -> tuple[Report, float | None]:
    """Return the report, and the wall time of the assessment [s] where it is known."""
    with tempfile.TemporaryDirectory(prefix="palpate-case-") as temporary:
        folder = Path(temporary)
        if runs is not None:
            folder = runs / case.case_id
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir(parents=True)
        if case.runtime == "lockstep":
            result = run_composed(scenario, folder, lambda _: None, observers=())
        else:
            result = run_distributed(scenario, folder, lambda _: None, (), Timing(wallclock=True))
    if result.interrupted:
        raise RunError("interrupted")
    blame = result.blame.get("assessment")
    if runs is None:
        report = assemble(scenario, result, truth_of_run(scenario, result.collected))
    else:
        report = write_results(folder, scenario, result)
        write_page(folder)
    return report, None if blame is None else blame["steps"] * blame["compute"] / 1e6


def _core_s() -> float:
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return process_time() + children.ru_utime + children.ru_stime


def _attempt(line: str, runs: Path | None) -> Attempt:
    try:
        return examine(Case.model_validate_json(line), runs)
    except Exception as error:  # any error is a failed attempt at this case
        return Attempt(why=f"{type(error).__name__}: {error}", code=code_digest())


def _end_with(parent: int) -> None:
    """End this process as soon as its parent has ended."""
    while os.getppid() == parent:
        sleep(1.0)
    os._exit(1)


if __name__ == "__main__":
    Thread(target=_end_with, args=(os.getppid(),), daemon=True).start()
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "w", encoding="utf-8")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # output of libraries is not an answer
    for text in sys.stdin.read().splitlines():
        answers.write(_attempt(text, Path(sys.argv[1]) if len(sys.argv) > 1 else None).model_dump_json() + "\n")
        answers.flush()
