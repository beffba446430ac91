"""Who gives way on a machine with fewer cores than services: the calling thread, and the threads that it starts later."""

from __future__ import annotations

import os
from contextlib import suppress

from palpate_bus.contract import MS

WORKER = 15
"""Niceness of a thread that computes for seconds: a planner must not keep the 1 kHz loop from a core."""
_BY_PERIOD = ((100 * MS, 10), (10 * MS, 5))


def give_way(niceness: int) -> None:
    """Lowers the priority by `niceness`, where the system lets it."""
    with suppress(OSError, AttributeError):
        here = os.getpriority(os.PRIO_PROCESS, 0)  # to Linux 0 is the thread that calls
        os.setpriority(os.PRIO_PROCESS, 0, here + niceness)


def by_period(period: int) -> int:
    """Niceness of a service on its own timer: who steps more seldom [ns] gives way (rate-monotonic)."""
    return next((niceness for least, niceness in _BY_PERIOD if period >= least), 0)


def when_idle() -> None:
    """Runs only when the cores would idle: for observers.

    With the usual policy one that has just been woken may keep a core for milliseconds, of which a tick has less than one.
    """
    with suppress(OSError, AttributeError):  # SCHED_IDLE is Linux's
        os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
