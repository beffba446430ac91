"""Garbage collection, priorities, and the state of processes: running, waiting for a core, or frozen."""

import gc
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from time import monotonic
from typing import Final, NamedTuple

import psutil

from palpate_bus.messages import MS

GC_THRESHOLD = 100_000
"""New objects before a garbage collection. Messages form no cycles: a run of 50 s leaves 2000 objects in cycles."""
WORKER_NICENESS = 15
"""Niceness, in wall-clock mode, of a thread that computes for seconds: a planner must not take the core of the 1 kHz loop."""
BACKGROUND_NICENESS = 3
"""Niceness of observers, and in lockstep of services slower than the 1 kHz loop, which are batch work as well.

The loop waits for them, so with a higher value a run starves next to other work. Toy services, 2 s of simulated time on two
loaded cores next to two busy processes, interleaved: with 15 no end within 100 s, and a lost message; with 3 in 6.5 and 11.5 s.
"""
_NICENESS_BY_PERIOD = ((100 * MS, 10), (10 * MS, 1))
STOPPED: Final = frozenset({psutil.STATUS_STOPPED, psutil.STATUS_TRACING_STOP})
ENDED: Final = frozenset({psutil.STATUS_ZOMBIE, psutil.STATUS_DEAD})


@contextmanager
def rare_collections() -> Iterator[None]:
    """Freeze existing objects and raise the GC threshold. A full collection during a run took 0.06 to 0.17 s."""
    thresholds = gc.get_threshold()
    gc.freeze()
    gc.set_threshold(GC_THRESHOLD)
    try:
        yield
    finally:
        gc.set_threshold(*thresholds)
        gc.unfreeze()


def lower_priority(niceness: int) -> None:
    """Raise the niceness of the calling thread, if the system allows it. Threads that it starts later inherit it."""
    with suppress(OSError, AttributeError):
        current = os.getpriority(os.PRIO_PROCESS, 0)  # on Linux 0 is the calling thread
        os.setpriority(os.PRIO_PROCESS, 0, current + niceness)


def niceness_of_period(period: int) -> int:
    """Return the niceness of a service on its own timer: the longer its period [ns], the lower its priority (rate-monotonic)."""
    return next((niceness for least, niceness in _NICENESS_BY_PERIOD if period >= least), 0)


def run_in_background() -> None:
    """Lower the priority of the calling thread and of the threads it starts later; call it before zenoh starts its own.

    A thread that is batch work does not preempt a running thread when it wakes, which otherwise costs a tick milliseconds. With
    a low weight it still makes progress on a loaded machine; with SCHED_IDLE a viewer did not even start.
    """
    with suppress(OSError, AttributeError):  # Linux only
        os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))
    lower_priority(BACKGROUND_NICENESS)


@cache
def pid_space() -> str:
    """Return the boot id of this machine and its namespace of process ids; empty if unknown.

    A process with the same value can inspect ours by its id.
    """
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
        return f"{boot} {Path('/proc/self/ns/pid').readlink()}"
    except OSError:
        return ""


def process_identity() -> dict[str, object]:
    """Return our process id and its namespace, for others that inspect it."""
    return {"pid": os.getpid(), "home": pid_space()}


def is_running(pid: int) -> bool:
    """Return True if the process exists and is not stopped. If it makes no progress it is starved of CPU."""
    try:
        status: str = psutil.Process(pid).status()
        return status not in STOPPED | ENDED
    except psutil.Error:
        return False


class Standstill(NamedTuple):
    """State of a process."""

    pid: int
    status: str
    """State by psutil's name; empty if the process cannot be inspected."""
    seconds: float
    """Time without processor time and without waiting for a core; 0 while it makes progress."""

    @property
    def stopped(self) -> bool:
        """True if a signal stopped it. A process stopped by a debugger counts as making progress."""
        return self.status == str(psutil.STATUS_STOPPED)


class Activity:
    """Distinguishes slow processes from frozen ones: a slow one uses processor time or waits for a core."""

    def __init__(self, pid: int) -> None:
        """Raise psutil.Error if the process does not exist."""
        self.pid = pid
        self._process = psutil.Process(pid)
        self._used = self._usage()
        self._active_at = monotonic()

    def check(self) -> Standstill:
        """Return its state. Call it often: activity between two calls is dated to the second."""
        status = ""
        try:
            used, status = self._usage(), self._process.status()
            active = used != self._used or status in ENDED or status == psutil.STATUS_TRACING_STOP or self._wants_core()
            self._used = used
        except psutil.Error:
            active = True
        if active:
            self._active_at = monotonic()
        return Standstill(self._process.pid, status, monotonic() - self._active_at if not active else 0.0)

    def _usage(self) -> tuple[float, ...]:
        """Return processor time of all threads [s] and the number of context switches of the first."""
        times, switches = self._process.cpu_times(), self._process.num_ctx_switches()
        return times.user, times.system, switches.voluntary, switches.involuntary

    def _wants_core(self) -> bool:
        """Return True if one of its threads could run."""
        return any(psutil.Process(thread.id).status() == psutil.STATUS_RUNNING for thread in self._process.threads())
