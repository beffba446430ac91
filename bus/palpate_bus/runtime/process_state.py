"""What another process of this machine does: whether it runs, waits for a core, or stands still."""

from __future__ import annotations

import os
from functools import cache
from pathlib import Path
from time import monotonic
from typing import Final

import psutil

HELD: Final = frozenset({psutil.STATUS_STOPPED, psutil.STATUS_TRACING_STOP})
"""A process that runs no more until somebody lets it go on, by a signal or by a debugger."""
OVER: Final = frozenset({psutil.STATUS_ZOMBIE, psutil.STATUS_DEAD})


@cache
def home() -> str:
    """The boot of this machine and the space in which its process ids count: who has the same can look at our process."""
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
        return f"{boot} {os.readlink('/proc/self/ns/pid')}"
    except OSError:
        return ""


def runs(pid: int) -> bool:
    """Whether a process is there and not held: what it does not do then, it has had no core for."""
    try:
        return psutil.Process(pid).status() not in HELD | OVER
    except psutil.Error:
        return False


class Activity:
    """Whether a process goes on: a slow one uses processor time or waits for a core, a frozen one does neither."""

    def __init__(self, pid: int) -> None:
        """Raises psutil.Error when there is no such process."""
        self._process = psutil.Process(pid)
        self._used = self._usage()
        self._went_on = monotonic()

    def frozen(self, seconds: float) -> str:
        """How the process stands still, if it has for `seconds` [s]; empty when it goes on, is over, or a debugger holds it.

        Look often: what it does between two looks counts as done at the second.
        """
        try:
            used, status = self._usage(), self._process.status()
            if used != self._used or status in OVER or status == psutil.STATUS_TRACING_STOP or self._wants_core():
                self._used, self._went_on = used, monotonic()
        except psutil.Error:
            return ""
        still = monotonic() - self._went_on
        if still < seconds:
            return ""
        return f"frozen: its process {self._process.pid} is {status} and has used no processor time for {still:.1f} s"

    def _usage(self) -> tuple[float, ...]:
        """Processor time of all threads [s], and how often the first was put on a core."""
        times, switches = self._process.cpu_times(), self._process.num_ctx_switches()
        return times.user, times.system, switches.voluntary, switches.involuntary

    def _wants_core(self) -> bool:
        """Whether one of its threads could run."""
        tasks = (psutil.Process(thread.id) for thread in self._process.threads())
        return any(task.status() == psutil.STATUS_RUNNING for task in tasks)
