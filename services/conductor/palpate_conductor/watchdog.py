"""Who blocks whom: from what every service last said of itself."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field
from time import monotonic

INTERRUPTED_S = 0.5
"""When all services are silent for so long, it is their way to the conductor that is interrupted; they report every 0.2 s."""


@dataclass
class RoleProgress:
    """What one service last reported."""

    tick: int = -1
    """Last finished tick [ns]."""
    waiting_for: str = ""
    """Topic it waits for, `grant`, or empty."""
    reported: float = field(default_factory=monotonic)
    moved: float = field(default_factory=monotonic)
    """When it last finished a tick, by the monotonic clock [s]."""


class RunWatchdog:
    """Keeps the progress of every service and names the one that holds the others up."""

    def __init__(self, roles: tuple[str, ...], producers: dict[str, str]) -> None:
        """`producers` gives the producing role of each topic."""
        self.progress = {role: RoleProgress() for role in roles}
        self._producers = producers
        self._longest_silence = 0.0

    def report(self, role: str, tick: int, waiting_for: str) -> None:
        """Takes a report. A role that the run does not have is ignored."""
        progress = self.progress.get(role)
        if progress is None:
            return
        now = monotonic()
        progress.reported = now
        progress.waiting_for = waiting_for
        if tick > progress.tick:
            progress.tick = tick
            progress.moved = now

    def silent_for(self) -> float:
        """Seconds since any service was heard of, whatever it said: they report while they wait, too."""
        return monotonic() - max(progress.reported for progress in self.progress.values())

    def note_silence(self) -> None:
        """Remembers how long nothing has been heard of any service."""
        self._longest_silence = max(self._longest_silence, self.silent_for())

    @property
    def interruption(self) -> str:
        """That the transport was interrupted for a while, as it seems here; empty if it was not."""
        silent = self._longest_silence
        if silent < INTERRUPTED_S:
            return ""
        return f"for {silent:.1f} s nothing was heard of any service: the transport or the whole machine stood still"

    def stalled_for(self) -> float:
        """Seconds since any service finished a tick."""
        return monotonic() - max(progress.moved for progress in self.progress.values())

    def longest_stall(self, roles: Collection[str]) -> float:
        """Seconds since that one of `roles` which is furthest behind its own clock finished a tick (wall-clock runs)."""
        return monotonic() - min((self.progress[role].moved for role in roles), default=monotonic())

    def forgive(self) -> None:
        """Starts the stall anew: while the run is paused nobody is to blame."""
        now = monotonic()
        for progress in self.progress.values():
            progress.moved = now

    def culprit(self, roles: Collection[str]) -> tuple[str, str]:
        """The one of `roles` that blocks, and a sentence that says whom.

        Follows who-waits-for-whom from the slowest waiting service to one that waits for nobody; a circle is named as one.
        """
        waiting = {
            role: self._producers[p.waiting_for]
            for role, p in self.progress.items()
            if role in roles and self._producers.get(p.waiting_for) in roles
        }
        if all(self.progress[role].waiting_for == "grant" for role in roles):
            return "conductor", "everyone waits for the conductor to grant time: planning or the recorder has fallen behind"
        if not waiting:
            role = min(roles, key=lambda name: self.progress[name].moved)
            return (
                role,
                f"{role} has not finished a tick since {self.progress[role].tick / 1e9:.3f} s; nobody waits for it",
            )
        role = min(waiting, key=lambda name: self.progress[name].tick)
        path = [role]
        while path[-1] in waiting:
            follower = waiting[path[-1]]
            if follower in path:
                return follower, f"circle of waiting: {' -> '.join([*path[path.index(follower) :], follower])}"
            path.append(follower)
        culprit = path[-1]
        blocked = sorted(name for name in waiting if name != culprit)
        return culprit, (
            f"{culprit} is at {self.progress[culprit].tick / 1e9:.3f} s and waits for nobody; "
            f"{', '.join(f'{name} (for {self.progress[name].waiting_for})' for name in blocked)} wait"
        )
