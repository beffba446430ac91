"""What another process of this machine does: whether it runs, waits for a core, or stands still."""

from __future__ import annotations

import os
from functools import cache
from pathlib import Path
from time import monotonic
from typing import Final, NamedTuple

import psutil

HELD: Final = frozenset({psutil.STATUS_STOPPED, psutil.STATUS_TRACING_STOP})
"""A process that runs no more until somebody lets it go on, by a signal or by a debugger."""
OVER: Final = frozenset({psutil.STATUS_ZOMBIE, psutil.STATUS_DEAD})


@cache
def home() -> str:
    """The boot of this machine and the space in which its process ids count: who has the same can look at our process."""
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
        return f"{boot} {Path('/proc/self/ns/pid').readlink()}"
    except OSError:
        return ""


def runs(pid: int) -> bool:
    """Whether a process is there and not held: what it does not do then, it has had no core for."""
    try:
        status: str = psutil.Process(pid).status()
        return status not in HELD | OVER
    except psutil.Error:
        return False


def whereabouts() -> dict[str, object]:
    """Where our process is, for others that may look at it."""
    return {"pid": os.getpid(), "home": home()}


class Standstill(NamedTuple):
    """How a process was found."""

    pid: int
    status: str
    """As psutil names it; empty when it could not be looked at."""
    seconds: float
    """For how long it has used no processor time and has not waited for a core; 0 when it goes on."""

    @property
    def held(self) -> bool:
        """Whether a signal has stopped it. One that a debugger holds counts as going on."""
        return self.status == str(psutil.STATUS_STOPPED)


class Activity:
    """Whether a process goes on: a slow one uses processor time or waits for a core, a frozen one does neither."""

    def __init__(self, pid: int) -> None:
        """Raises psutil.Error when there is no such process."""
        self.pid = pid
        self._process = psutil.Process(pid)
        self._used = self._usage()
        self._went_on = monotonic()

    def look(self) -> Standstill:
        """How it is. Look often: what it does between two looks counts as done at the second."""
        status = ""
        try:
            used, status = self._usage(), self._process.status()
            goes_on = used != self._used or status in OVER or status == psutil.STATUS_TRACING_STOP or self._wants_core()
            self._used = used
        except psutil.Error:
            goes_on = True
        if goes_on:
            self._went_on = monotonic()
        return Standstill(self._process.pid, status, monotonic() - self._went_on if not goes_on else 0.0)

    def _usage(self) -> tuple[float, ...]:
        """Processor time of all threads [s], and how often the first was put on a core."""
        times, switches = self._process.cpu_times(), self._process.num_ctx_switches()
        return times.user, times.system, switches.voluntary, switches.involuntary

    def _wants_core(self) -> bool:
        """Whether one of its threads could run."""
        tasks = (psutil.Process(thread.id) for thread in self._process.threads())
        return any(task.status() == psutil.STATUS_RUNNING for task in tasks)
