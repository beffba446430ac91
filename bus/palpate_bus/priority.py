"""Who gives way on a machine with fewer cores than services: the calling thread, and the threads that it starts later."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

from palpate_bus.contract import MS

WORKER = 15
"""Niceness of a thread that computes for seconds: a planner must not keep the 1 kHz loop from a core."""
BACKGROUND = 15
"""Niceness of observers, and in lockstep of services slower than the 1 kHz loop, which have a period's time to answer.

Alternating short runs with recorder and viewer on two cores: 1.27, 1.31 and 1.30 times real time with services at 15 and
observers at 10, 1.31, 1.24 and 1.39 with both at 15, 1.21, 1.14 and 1.23 with services at 0.
"""
_BY_PERIOD = ((100 * MS, 10), (10 * MS, 5))


def give_way(niceness: int) -> None:
    """Lowers the priority by `niceness`, where the system lets it."""
    with suppress(OSError, AttributeError):
        here = os.getpriority(os.PRIO_PROCESS, 0)  # to Linux 0 is the thread that calls
        os.setpriority(os.PRIO_PROCESS, 0, here + niceness)


def in_lockstep(period: int) -> int:
    """Niceness of a service in lockstep: all that its period [ns] lets wait stay behind the loop that everything waits for."""
    return BACKGROUND if period > MS else 0


def by_period(period: int) -> int:
    """Niceness of a service on its own timer: who steps more seldom [ns] gives way (rate-monotonic)."""
    return next((niceness for least, niceness in _BY_PERIOD if period >= least), 0)


def in_the_background() -> None:
    """Puts all threads of this process behind others: for observers, once they have started.

    As batch work they take no core from who is running when they wake, which with the usual policy costs a tick milliseconds; and
    with a small weight they still go on where others load the machine. SCHED_IDLE would not: a viewer did not even start.
    """
    with suppress(OSError, AttributeError):  # Linux
        for thread in (int(path.name) for path in Path("/proc/self/task").iterdir()):
            with suppress(OSError):
                os.sched_setscheduler(thread, os.SCHED_BATCH, os.sched_param(0))
                os.setpriority(os.PRIO_PROCESS, thread, BACKGROUND)
