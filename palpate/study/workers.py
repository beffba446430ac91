"""Who examines the cases: workers of a Dask cluster, on this machine or elsewhere, or threads of this process."""

from __future__ import annotations

import logging
import os
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import Final

from palpate.environment import FIXED
from palpate.study.child import kill_all
from palpate_errors import RunError

CONNECT_S: Final = 30
"""How long a scheduler elsewhere has to answer."""


class WorkersError(RunError):
    """No workers can be had. Says why."""


@dataclass(frozen=True)
class Workers:
    """Something that examines cases, several at a time."""

    executor: Executor
    count: int
    """How many cases are examined at a time, as far as is known now: a cluster may grow."""
    dashboard: str | None
    """Where Dask shows what its workers do."""
    killers: tuple[type[Exception], ...] = ()
    """What a task raises whose worker was lost again and again."""
    alive: Callable[[], bool] = lambda: True
    """Whether anything can still come back: a client that has lost its scheduler waits for results for ever."""


def cores() -> int:
    """Processors that this process may use."""
    return len(os.sched_getaffinity(0))


@contextmanager
def threads(count: int) -> Iterator[Workers]:
    """Threads of this process, each with its own process for its case; no scheduler."""
    executor = ThreadPoolExecutor(count)
    try:
        yield Workers(executor, count, None)
    finally:
        executor.shutdown(wait=False, cancel_futures=True)
        kill_all()
        executor.shutdown(wait=True)


@contextmanager
def cluster(count: int, scheduler: str | None) -> Iterator[Workers]:
    """`count` Dask workers on this machine, or those of a scheduler elsewhere. Raises WorkersError.

    A worker has one thread; what a case needs of memory its own process has, so Dask does not watch the worker's.
    """
    from distributed import Client, KilledWorker, LocalCluster  # noqa: PLC0415 - shards do without

    with ExitStack() as stack:
        stack.enter_context(warnings.catch_warnings())
        warnings.filterwarnings("ignore", "Port .* is already in use")  # another study's: the address is told all the same
        try:
            if scheduler is None:
                local = stack.enter_context(
                    LocalCluster(
                        n_workers=count,
                        threads_per_worker=1,
                        memory_limit=0,
                        host="127.0.0.1",
                        env=FIXED,
                        silence_logs=logging.ERROR,
                    )
                )
                client = stack.enter_context(Client(local))
            else:
                client = stack.enter_context(Client(scheduler, timeout=CONNECT_S))
        except (OSError, ValueError, TimeoutError) as error:
            raise WorkersError(f"--scheduler {scheduler}: {error}" if scheduler else f"--workers {count}: {error}") from error
        known = sum(client.nthreads().values()) or 1
        yield Workers(
            client.get_executor(pure=False), known, client.dashboard_link, (KilledWorker,), lambda: client.status == "running"
        )
