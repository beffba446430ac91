"""Which service stands still: a slow one uses processor time or waits for a core, a frozen one does neither.

Only processes that the conductor can look at: those of this machine and of its own space of process ids, not of other
containers.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from time import monotonic, sleep
from typing import Any, Final

import psutil

from palpate_bus.runtime.process_state import Activity, home, runs
from palpate_conductor.outcome import Patience

LOOK_S: Final = 0.25
EXIT_S: Final = 0.05
"""A process that ends closes its connections before it is gone itself."""


class FreezeWatch:
    """Looks at the processes of a run's services."""

    def __init__(self, patience: Patience) -> None:
        self._patience = patience
        self._activity: dict[str, Activity] = {}
        self._looked = 0.0

    def meet(self, role: str, detail: Mapping[str, Any]) -> None:
        """Takes what a service says of its process when it is ready."""
        if role not in self._activity and detail.get("home") == home() != "":
            with suppress(psutil.Error):
                self._activity[role] = Activity(int(detail["pid"]))

    def gone(self, role: str) -> str:
        """How a service whose connection is gone went, as far as its process tells."""
        activity = self._activity.get(role)
        if activity is None or not runs(activity.pid):
            return "its connection is gone"
        sleep(EXIT_S)
        if not runs(activity.pid):
            return "its connection is gone"
        return f"its connection is gone, but its process {activity.pid} runs: the way to it is broken, or the machine too busy"

    def frozen(self) -> dict[str, str]:
        """Who stands still, with how: those that somebody stopped; where there is none, those that have long slept.

        One that is stopped keeps others from sending to it, and these sleep without being at fault.
        """
        now = monotonic()
        if now - self._looked < LOOK_S:
            return {}
        self._looked = now
        still = {role: activity.look() for role, activity in self._activity.items()}
        held = {role: seen for role, seen in still.items() if seen.held}
        limit = self._patience.frozen if held else self._patience.asleep
        return {
            role: f"frozen: its process {seen.pid} is {seen.status} and has used no processor time for {seen.seconds:.1f} s"
            for role, seen in (held or still).items()
            if seen.seconds >= limit
        }
