"""The side of a worker: starts the processes that examine cases, gives them cases and hears what came of them.

`run_batch` is the task that is given to an executor, be it a thread of this process or a worker of a cluster. Whatever a worker
needs is in its arguments; whatever comes of it is what it returns.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import threading
import weakref
from collections.abc import Mapping, Sequence
from typing import Final

from palpate.environment import FIXED
from palpate.study.case import Attempt
from palpate.study.manifest import Case
from palpate_bus.settings import variable

LIMIT_S: Final = {"whole": 3600.0, "quick": 300.0}
"""A case that takes longer has hung."""
KEEP_MEMORY: Final = {"MALLOC_TRIM_THRESHOLD_": str(1 << 30), "MALLOC_MMAP_THRESHOLD_": str(1 << 25)}
"""glibc's malloc keeps what a case frees for the next arrays. Dask has its workers' children give it back at once, which costs a
tenth of a quick case in page faults, and a fifth where two run."""
_warm = threading.local()
"""The warm process of each thread of a worker."""
_living: weakref.WeakSet[CaseProcess] = weakref.WeakSet()


class CaseProcess:
    """A process that examines cases."""

    def __init__(self, environment: Mapping[str, str], runs: str | None = None) -> None:
        """Starts it, with variables beside those that make results repeatable; `runs` as in `run_batch`."""
        self._log = tempfile.TemporaryFile(mode="w+", encoding="utf-8", errors="replace")  # noqa: SIM115 - `close` does
        self._process = subprocess.Popen(
            [sys.executable, "-m", "palpate.study.case", *([] if runs is None else [runs])],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._log,
            text=True,
            env={**os.environ, **FIXED, **KEEP_MEMORY, **environment},
            start_new_session=True,  # Ctrl-C is for the study, which closes its processes
        )
        _living.add(self)

    @property
    def lives(self) -> bool:
        """Whether it can take another case."""
        return self._process.poll() is None

    def examine(self, case: Case, limit_s: float) -> Attempt:
        """What came of a case. A process that ends, or takes longer than `limit_s`, is an attempt without a report."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        late = threading.Event()

        def end() -> None:
            late.set()
            self.kill()

        timer = threading.Timer(limit_s, end)
        timer.daemon = True
        timer.start()
        try:
            self._process.stdin.write(case.model_dump_json() + "\n")
            self._process.stdin.flush()
            answer = self._process.stdout.readline()
        except BrokenPipeError:
            answer = ""
        finally:
            timer.cancel()
        if answer.endswith("\n"):
            return Attempt.model_validate_json(answer)
        status = self._process.wait()
        why = (
            f"took longer than {limit_s:.0f} s"
            if late.is_set()
            else f"its process ended with status {status}{self._last_words()}"
        )
        return Attempt(case_id=case.case_id, report=None, why=why)

    def kill(self) -> None:
        """Ends it at once; who waits for its answer hears that."""
        self._process.kill()

    def close(self) -> None:
        """Ends it, and forgets it."""
        self.kill()
        self._process.wait()
        for file in (self._process.stdin, self._process.stdout, self._log):
            assert file is not None
            file.close()

    def _last_words(self) -> str:
        self._log.seek(0)
        lines = self._log.read().strip().splitlines()
        return f": {lines[-1]}" if lines else ""


def kill_all() -> None:
    """Ends all processes that this one has started for cases, so that threads that wait for them are free."""
    for process in list(_living):
        process.kill()


def run_batch(batch: Sequence[str], runs: str | None = None) -> list[str]:
    """Examines cases, given as JSON, one after another; the outcome of each, as JSON in the same order.

    `runs`: folder in which the results of whole examinations stay, where the worker is.
    """
    cases = [Case.model_validate_json(text) for text in batch]
    return [(_in_warm(case) if case.tier == "quick" else _in_own(case, runs)).model_dump_json() for case in cases]


def _in_own(case: Case, runs: str | None) -> Attempt:
    periods = {variable("periods"): ",".join(f"{role}={period}" for role, period in case.periods.items())} if case.periods else {}
    process = CaseProcess(periods, runs)
    try:
        return process.examine(case, LIMIT_S[case.tier])
    finally:
        process.close()


def _in_warm(case: Case) -> Attempt:
    process: CaseProcess | None = getattr(_warm, "process", None)
    if process is None or not process.lives:
        process = _warm.process = CaseProcess({})
    return process.examine(case, LIMIT_S[case.tier])
