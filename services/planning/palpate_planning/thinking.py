"""Heavy planning beside the steps, at a simulated price.

A motion planner may think for seconds, set-points are due every 10 ms, and on hardware they expire after 250 ms. So heavy
work runs on a worker thread while the steps go on, and its result is taken up a fixed simulated time later. In lockstep
the step that takes it waits for it, so what a step returns never depends on how fast the worker was. On a wall clock
nothing waits: the result is taken up when it is there, but not before its time.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Generic, TypeVar

T = TypeVar("T")

WORKER = ThreadPoolExecutor(max_workers=1, thread_name_prefix="planning")
"""The one worker of the process: CasADi and OMPL are not safe in two threads at once, and a thought that is not wanted any more
goes on to its end."""


class Thought(Generic[T]):
    """One piece of work: started at `t` [ns], its result taken at `t + budget`. `work` must share no state with the steps."""

    def __init__(self, t: int, budget: int, work: Callable[[], T], *, lockstep: bool = True) -> None:
        self._due = t + budget
        self._lockstep = lockstep
        self._future: Future[T] = WORKER.submit(work)

    def due(self, t: int) -> bool:
        """Whether its time has come."""
        return t >= self._due and (self._lockstep or self._future.done())

    def result(self) -> T:
        """The result, waited for where need be; re-raises what the work raised."""
        return self._future.result()
