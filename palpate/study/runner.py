"""Runs the cases of a study on Dask workers: threads of this process, or the workers of a scheduler elsewhere."""

import logging
import os
import re
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from time import monotonic
from typing import Any, Final, Literal

import psutil

from palpate.study.case import run_batch
from palpate.study.cases import Case
from palpate.study.folder import ATTEMPTS, Attempt, Folder, Outcome, Session
from palpate.study.spec import StudyError
from palpate_errors import RunError

CONNECT_S: Final = 30
"""Time limit for the connection to a scheduler."""
BATCH: Final = {"whole": 1, "quick": 8}
"""Maximum number of cases of one task; they share a process."""
TASKS_A_WORKER: Final = 4
"""Minimum number of tasks for each worker, so that none waits for another at the end."""
POLL_S: Final = 2.0
"""Interval of the check that the scheduler is alive."""


class StudyStopped(RunError):
    """The workers are gone or cannot work. Finished cases are kept."""


@dataclass(frozen=True)
class Workers:
    """Dask workers."""

    client: Any
    executor: Executor
    count: int
    """Cases at a time, as known at the start: a cluster may grow."""
    killed: type[Exception]
    """Raised for a task whose worker was lost repeatedly."""

    @property
    def alive(self) -> bool:
        """True if the client is connected; one without a scheduler would wait for ever."""
        return bool(self.client.status == "running")


def cores() -> int:
    """Return the number of processors that this process may use."""
    return len(os.sched_getaffinity(0))


@contextmanager
def cluster(count: int, scheduler: str | None = None) -> Iterator[Workers]:
    """`count` worker threads in this process, or the workers of a scheduler elsewhere. Raises StudyError.

    Local workers are threads because each case is examined in a process of its own.
    """
    from distributed import Client, KilledWorker, LocalCluster  # noqa: PLC0415 - takes a second

    with ExitStack() as stack:
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
                stack.callback(_end_cases)
                stack.enter_context(local)
                client = stack.enter_context(Client(local))
            else:
                client = stack.enter_context(Client(scheduler, timeout=CONNECT_S))
        except (OSError, ValueError, TimeoutError) as error:
            raise StudyError(f"--scheduler {scheduler}: {error}" if scheduler else f"--workers {count}: {error}") from error
        known = sum(client.nthreads().values()) or 1
        executor = client.get_executor(pure=False)
        if scheduler is None:
            stack.callback(_end_cases)
        stack.callback(executor.shutdown, wait=False)
        yield Workers(client, executor, known, KilledWorker)


def _end_cases() -> None:
    """End the case processes of an interrupted study, so that the threads that wait for them end."""
    for child in psutil.Process().children():
        if "palpate.study.case" in child.cmdline():
            child.kill()


def part_of(cases: Sequence[Case], shard: str) -> list[Case]:
    """Return every n-th case from the i-th, for a shard `i/n`. Raises StudyError."""
    words = re.fullmatch(r"(\d+)/(\d+)", shard)
    if words is None or not 1 <= int(words[1]) <= int(words[2]):
        raise StudyError(f"--shard {shard}: want i/n with 1 <= i <= n, such as 2/5")
    return list(cases[int(words[1]) - 1 :: int(words[2])])


def run_cases(
    folder: Folder, cases: Sequence[Case], workers: Workers, done: Callable[[Outcome], None], *, runs: bool = False
) -> None:
    """Examine all cases without an outcome, in any order, and calls `done` after each; note the session. Raises StudyStopped.

    `runs`: keep the results of whole examinations in the folder `runs`.
    """
    begin, finished = monotonic(), 0

    def count(outcome: Outcome) -> None:
        nonlocal finished
        finished += 1
        done(outcome)

    try:
        _run(folder, cases, workers, count, runs)
    finally:
        if finished:
            session = Session(workers=workers.count, cases=finished, elapsed_s=round(monotonic() - begin, 1))
            folder.write_sessions([*folder.sessions(), session])


def _run(folder: Folder, cases: Sequence[Case], workers: Workers, done: Callable[[Outcome], None], runs: bool) -> None:
    todo, kept = folder.missing(cases), str((folder.path / "runs").resolve()) if runs else None
    running: dict[Future[list[str]], list[Case]] = {}

    def submit(batch: list[Case]) -> None:
        running[workers.executor.submit(run_batch, [case.model_dump_json() for case in batch], kept)] = batch

    size = max(1, min(BATCH[todo[0].tier], len(todo) // (TASKS_A_WORKER * workers.count))) if todo else 1
    for batch in _batches(todo, size):
        submit(batch)
    while running:
        ended, _ = wait(running, timeout=POLL_S, return_when=FIRST_COMPLETED)
        if not ended and not workers.alive:
            raise StudyStopped("connection to the scheduler lost")
        for future in ended:
            batch = running.pop(future)
            attempts = _attempts(future, batch, workers)
            for case, attempt in zip(batch, attempts, strict=False):
                outcome = _outcome(folder, case, attempt)
                if outcome is None:
                    submit([case])
                else:
                    folder.write(outcome)
                    done(outcome)
            if rest := batch[len(attempts) :]:
                submit(rest)


def _batches(cases: Sequence[Case], size: int) -> Iterator[list[Case]]:
    """Yield up to `size` consecutive cases with the same periods, which are set for a whole process."""
    batch: list[Case] = []
    for case in cases:
        if batch and (len(batch) == size or case.periods != batch[0].periods):
            yield batch
            batch = []
        batch.append(case)
    if batch:
        yield batch


def _attempts(future: Future[list[str]], batch: Sequence[Case], workers: Workers) -> list[Attempt]:
    """Return the attempts of a batch. A batch whose workers are lost repeatedly counts as their cause."""
    if future.cancelled():
        raise StudyStopped("connection to the scheduler lost")
    error = future.exception()
    if error is None:
        return [Attempt.model_validate_json(text) for text in future.result()]
    if isinstance(error, workers.killed):
        return [Attempt(why=f"its workers were lost: {error}")] * len(batch)
    raise StudyStopped(f"a worker cannot examine: {type(error).__name__}: {error}") from error


def _outcome(folder: Folder, case: Case, attempt: Attempt) -> Outcome | None:
    """Return the outcome of a case after an attempt; None if it is to be tried again."""
    failures = folder.failures(case.case_id)
    if attempt.why is not None:
        failures.append(attempt.why)
        folder.write_failures(case.case_id, failures)
        if len(failures) < ATTEMPTS:
            return None
    told = dict(attempt) if attempt.report is None else {**dict(attempt), "why": attempt.report.failure}
    status: Literal["done", "failed"] = "done" if attempt.why is None else "failed"
    return Outcome(case=case, status=status, attempts=len(failures) + (attempt.why is None), **told)
