"""A background worker for planning that takes longer than a step.

A motion planner may need seconds, while set-points are due at every step and expire. So heavy planning runs on a worker thread
while the steps go on, and its result is used a fixed simulated time later. In lockstep the step that uses the result waits for
it, so what a step returns never depends on how fast the machine is. On a wall clock nothing waits: the result is used when it
is there, but not before its time.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Generic, TypeVar

T = TypeVar("T")

WORKER = ThreadPoolExecutor(max_workers=1, thread_name_prefix="planning")
"""The one worker of the process, since CasADi and OMPL are not safe in two threads at once. A task whose result is no longer
wanted runs to its end."""


class BackgroundTask(Generic[T]):
    """One task on the worker: started at `t` [ns], result used at `t + duration`. `work` must share no state with the steps."""

    def __init__(self, t: int, duration: int, work: Callable[[], T], *, lockstep: bool = True) -> None:
        self._due = t + duration
        self._lockstep = lockstep
        self._future: Future[T] = WORKER.submit(work)

    def due(self, t: int) -> bool:
        """Whether the result is to be used at `t` [ns]."""
        return t >= self._due and (self._lockstep or self._future.done())

    def result(self) -> T:
        """The result; waits for it, and raises again what the work raised."""
        return self._future.result()
