"""Runs the cases of a study on Dask workers: threads of this process, or the workers of a scheduler elsewhere.

Each case is examined in a process of its own: `python -m palpate.study.runner [RUNS]` reads cases and prints an attempt per line.
Its environment is fixed (one thread of BLAS and OpenMP, fixed hash seed), so that results do not depend on the worker. It ends
when the worker that started it ends. Results of whole examinations stay in RUNS/CASE_ID if RUNS is given.
"""

import logging
import os
import re
import resource
import shutil
import subprocess
import sys
import tempfile
import warnings
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from itertools import groupby
from operator import attrgetter
from pathlib import Path
from threading import Thread
from time import monotonic, perf_counter, process_time, sleep
from typing import Any, Final, Literal, NamedTuple

import psutil

from palpate.environment import FIXED
from palpate.report.page import write_page
from palpate.report.results import assemble, truth_of_run, write_results
from palpate.report.rows import Report
from palpate.run.composed import run_composed
from palpate.run.distributed import run_distributed
from palpate.study.cases import Case, file_hash
from palpate.study.folder import ATTEMPTS, Attempt, Folder, Outcome, Session, code_digest
from palpate.study.spec import StudyError
from palpate_bus.settings import variable
from palpate_conductor.outcome import Timing
from palpate_errors import RunError
from palpate_models.scenario.schema import Scenario

CASE_LIMIT_S: Final = {"whole": 3600.0, "quick": 300.0}
"""Time limit of a case; one that takes longer counts as hung."""
MALLOC_SETTINGS: Final = {"MALLOC_TRIM_THRESHOLD_": str(1 << 30), "MALLOC_MMAP_THRESHOLD_": str(1 << 25)}
"""Makes glibc's malloc keep freed memory for the next arrays; page faults would cost a tenth of a quick case."""
KIB: Final = 1024
"""Unit of `ru_maxrss` on Linux."""


def examine_batch(batch: Sequence[str], runs: str | None = None) -> list[str]:
    """Examine cases, given as JSON, one after another in one process; the task of a Dask worker.

    Returns the attempts as JSON, in order. If the process ends early the list is shorter than `batch` and its last attempt is the
    failure of the case being examined. `runs`: folder on the worker for the results of whole examinations.
    """
    cases = [Case.model_validate_json(text) for text in batch]
    periods = ",".join(f"{role}={period}" for role, period in cases[0].periods.items())
    environment = {**os.environ, **FIXED, **MALLOC_SETTINGS, **({variable("periods"): periods} if periods else {})}
    limit_s = CASE_LIMIT_S[cases[0].tier] * len(cases)
    command = [sys.executable, "-m", "palpate.study.runner", *([] if runs is None else [runs])]
    with tempfile.TemporaryFile("w+", encoding="utf-8", errors="replace") as log:
        try:
            process = subprocess.run(
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
            output, cause = process.stdout, f"its process ended with status {process.returncode}"
        except subprocess.TimeoutExpired as error:
            partial = error.stdout or b""
            output = partial.decode(errors="replace") if isinstance(partial, bytes) else partial
            cause = f"took longer than {limit_s:.0f} s"
        log.seek(0)
        logged = log.read().strip().splitlines()
    *attempts, _ = output.split("\n")  # texts may have other line separators, which splitlines() would split at
    if len(attempts) < len(cases):
        attempts.append(Attempt(why=f"{cause}: {logged[-1]}" if logged else cause).model_dump_json())
    return attempts


def examine(case: Case, runs: Path | None = None) -> Attempt:
    """Examine a patient in this process. A failed run is part of the report; errors of the code are raised."""
    begin, processor_begin = perf_counter(), _processor_time_s()
    for path, known in case.files.items():
        if (found := file_hash(path)) != known:
            raise RunError(f"{path} has changed since the study was made: SHA-256 {found[:16]}..., expected {known[:16]}...")
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
        report, assess_s = _examine_whole(scenario, case, runs)
    # a composed run is forked and shares memory
    peaks = [resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return Attempt(
        report=report,
        why=report.failure if case.runtime == "wallclock" else None,  # in simulated time it would fail again in the same way
        code=code_digest(),
        peak_memory_bytes=KIB * (max(peaks) if case.runtime == "lockstep" else sum(peaks)),
        wall_time_s=perf_counter() - begin,
        assess_time_s=assess_s,
        core_s=_processor_time_s() - processor_begin,
        loop_examinations=examinations,
    )


def _examine_whole(scenario: Scenario, case: Case, runs: Path | None) -> tuple[Report, float | None]:
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


def _processor_time_s() -> float:
    """Return the processor time of this process and its ended children [s]."""
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return process_time() + children.ru_utime + children.ru_stime


def _examine_line(line: str, runs: Path | None) -> Attempt:
    try:
        return examine(Case.model_validate_json(line), runs)
    except Exception as error:  # any error is a failed attempt at this case
        return Attempt(why=f"{type(error).__name__}: {error}", code=code_digest())


def _exit_with_parent(parent: int) -> None:
    """End this process as soon as its parent has ended."""
    while os.getppid() == parent:
        sleep(1.0)
    os._exit(1)


class PoolTuning(NamedTuple):
    """Distribution of cases to workers."""

    connect_s: int = 30
    """Time limit for the connection to a scheduler."""
    tasks_per_worker: int = 4
    """Minimum number of tasks for each worker, so that none waits for another at the end."""
    poll_s: float = 2.0
    """Interval of the check that the scheduler is alive."""


POOL: Final = PoolTuning()
MAX_CASES: Final = {"whole": 1, "quick": 8}
"""Maximum number of cases of one task; they share a process."""


class StudyStopped(RunError):
    """The workers are gone or cannot work. Finished cases are kept."""


@dataclass(frozen=True)
class Workers:
    """Dask workers."""

    client: Any
    executor: Executor
    count: int
    """Cases at a time, as known at the start: a cluster may grow."""


def count_cores() -> int:
    """Return the number of processors that this process may use."""
    return len(os.sched_getaffinity(0))


@contextmanager
def open_workers(count: int, scheduler: str | None = None) -> Iterator[Workers]:
    """Yield `count` worker threads of this process, or the workers of a scheduler elsewhere. Raises StudyError.

    Local workers are threads because each case is examined in a process of its own.
    """
    import dask  # noqa: PLC0415 - takes a second
    from distributed import Client, LocalCluster  # noqa: PLC0415

    with ExitStack() as stack:
        if scheduler is None:  # after a computer's sleep its own worker counted as lost, and the study waited for ever
            stack.enter_context(dask.config.set({"distributed.scheduler.worker-ttl": None}))
        stack.enter_context(warnings.catch_warnings())
        warnings.filterwarnings("ignore", "Port .* is already in use")  # by another study; the address is printed anyway
        try:
            if scheduler is None:
                local = LocalCluster(
                    n_workers=1,
                    threads_per_worker=count,
                    processes=False,
                    memory_limit=0,
                    dashboard_address="127.0.0.1:8787",
                    silence_logs=logging.CRITICAL,
                )
                stack.callback(_kill_case_processes)
                stack.enter_context(local)
                client = stack.enter_context(Client(local))
            else:
                client = stack.enter_context(Client(scheduler, timeout=POOL.connect_s))
        except (OSError, ValueError, TimeoutError) as error:
            raise StudyError(f"--scheduler {scheduler}: {error}" if scheduler else f"--workers {count}: {error}") from error
        started = sum(client.nthreads().values()) or 1
        executor = client.get_executor(pure=False)
        if scheduler is None:
            stack.callback(_kill_case_processes)
        stack.callback(executor.shutdown, wait=False)
        yield Workers(client, executor, started)


def _kill_case_processes() -> None:
    """End the case processes of an interrupted study, so that the threads that wait for them end."""
    for child in psutil.Process().children():
        with suppress(psutil.NoSuchProcess):  # it has just ended
            if "palpate.study.runner" in child.cmdline():
                child.kill()


def select_shard(cases: Sequence[Case], shard: str) -> list[Case]:
    """Return every n-th case from the i-th, for a shard `i/n`. Raises StudyError."""
    match = re.fullmatch(r"(\d+)/(\d+)", shard)
    if match is None or not 1 <= int(match[1]) <= int(match[2]):
        raise StudyError(f"--shard {shard}: expected i/n with 1 <= i <= n, such as 2/5")
    return list(cases[int(match[1]) - 1 :: int(match[2])])


def run_cases(
    folder: Folder, cases: Sequence[Case], workers: Workers, done: Callable[[Outcome], None], *, runs: bool = False
) -> None:
    """Examine all cases without an outcome, in any order; call `done` after each and append the session to the folder.

    `runs`: keep the results of whole examinations in the folder `runs`. Raises StudyStopped.
    """
    begin, finished = monotonic(), 0
    runs_folder = str((folder.path / "runs").resolve()) if runs else None
    running: dict[Future[list[str]], list[Case]] = {}
    failures: defaultdict[str, list[str]] = defaultdict(list)

    def submit(batch: list[Case]) -> None:
        running[workers.executor.submit(examine_batch, [case.model_dump_json() for case in batch], runs_folder)] = batch

    try:
        for batch in _batches(folder.missing(cases), workers.count):
            submit(batch)
        while running:
            ended, _ = wait(running, timeout=POOL.poll_s, return_when=FIRST_COMPLETED)
            if not ended and workers.client.status != "running":  # a client without a scheduler would wait for ever
                raise StudyStopped("connection to the scheduler lost")
            for future in ended:
                batch = running.pop(future)
                attempts = _attempts(future, batch)
                for case, attempt in zip(batch, attempts, strict=False):
                    outcome = _outcome(case, attempt, failures[case.case_id])
                    if outcome is None:
                        submit([case])
                    else:
                        folder.write(outcome)
                        finished += 1
                        done(outcome)
                if rest := batch[len(attempts) :]:
                    submit(rest)
    finally:
        if finished:
            session = Session(workers=workers.count, cases=finished, elapsed_s=round(monotonic() - begin, 1))
            folder.write_sessions([*folder.sessions(), session])


def _batches(cases: Sequence[Case], workers: int) -> Iterator[list[Case]]:
    """Yield consecutive cases with the same periods, which are set for a whole process, enough batches for all workers."""
    for _, group in groupby(cases, key=attrgetter("periods")):
        same = list(group)
        size = max(1, min(MAX_CASES[same[0].tier], len(cases) // (POOL.tasks_per_worker * workers)))
        yield from (same[k : k + size] for k in range(0, len(same), size))


def _attempts(future: Future[list[str]], batch: Sequence[Case]) -> list[Attempt]:
    """Return the attempts of a batch. If Dask gives up on a batch (KilledWorker), every case in it counts as failed."""
    from distributed import KilledWorker  # noqa: PLC0415 - takes a second

    if future.cancelled():
        raise StudyStopped("connection to the scheduler lost")
    error = future.exception()
    if error is None:
        return [_read_attempt(text) for text in future.result()]
    if isinstance(error, KilledWorker):
        return [Attempt(why=f"its workers were lost: {error}")] * len(batch)
    raise StudyStopped(f"a worker cannot examine: {type(error).__name__}: {error}") from error


def _read_attempt(text: str) -> Attempt:
    try:
        return Attempt.model_validate_json(text)
    except ValueError:
        return Attempt(why=f"its process wrote what is not an attempt: {text[:80]!r}")


def _outcome(case: Case, attempt: Attempt, failures: list[str]) -> Outcome | None:
    """Return the outcome of a case after an attempt; None if it is to be tried again. Adds its failure to `failures`."""
    if attempt.why is not None:
        failures.append(attempt.why)
        if len(failures) < ATTEMPTS:
            return None
    fields = dict(attempt) if attempt.report is None else {**dict(attempt), "why": attempt.report.failure}
    status: Literal["done", "failed"] = "done" if attempt.why is None else "failed"
    return Outcome(case=case, status=status, attempts=len(failures) + (attempt.why is None), failures=failures, **fields)


if __name__ == "__main__":
    Thread(target=_exit_with_parent, args=(os.getppid(),), daemon=True).start()
    attempts_out = os.fdopen(os.dup(sys.stdout.fileno()), "w", encoding="utf-8")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # output of libraries is not an attempt
    for text in sys.stdin.read().removesuffix("\n").split("\n"):
        attempts_out.write(_examine_line(text, Path(sys.argv[1]) if len(sys.argv) > 1 else None).model_dump_json() + "\n")
        attempts_out.flush()
