"""Priorities for a machine with fewer cores than services, of the calling thread and of the threads that it starts later."""

from __future__ import annotations

import os
from contextlib import suppress

from palpate_bus.contract import MS

WORKER = 15
"""Niceness of a thread that computes for seconds: a planner must not keep the 1 kHz loop from a core."""
BACKGROUND = 15
"""Niceness of observers, and in lockstep of services slower than the 1 kHz loop, which have a period's time to answer.

Alternating short runs with recorder and viewer on two cores, times real time. Services at 0, observers at 10: 1.21, 1.14, 1.23;
both at 15: 1.31, 1.24, 1.39. Later, services as batch work, too: 1.55, 1.55, 1.61, not so: 1.50, 1.54, 1.51.
"""
_BY_PERIOD = ((100 * MS, 10), (10 * MS, 5))


def give_way(niceness: int) -> None:
    """Lowers the priority by `niceness`, where the system lets it."""
    with suppress(OSError, AttributeError):
        here = os.getpriority(os.PRIO_PROCESS, 0)  # to Linux 0 is the thread that calls
        os.setpriority(os.PRIO_PROCESS, 0, here + niceness)


def by_period(period: int) -> int:
    """Niceness of a service on its own timer: the longer its period [ns], the lower its priority (rate-monotonic)."""
    return next((niceness for least, niceness in _BY_PERIOD if period >= least), 0)


def in_the_background() -> None:
    """Puts the calling thread behind others, and the threads that it starts later: call it before zenoh starts its own.

    As batch work they do not preempt a running thread when they wake, which otherwise costs a tick milliseconds. With little
    weight they still make progress on a loaded machine; with SCHED_IDLE a viewer did not even start.
    """
    with suppress(OSError, AttributeError):  # Linux
        os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))
    give_way(BACKGROUND)
