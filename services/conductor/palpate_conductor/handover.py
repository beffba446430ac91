"""Places that are kept: in a wall-clock run a service may be stopped and another process may take its place.

Only roles without which nothing dangerous happens, and whose work another process can go on with: what moves the arm, feels the
tissue or watches over both ends the run, and a perception that has not seen the first look does not know the wall.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from time import monotonic
from typing import Final

ROLES: Final = frozenset({"camera", "assessment"})


@dataclass
class Places:
    """Which places are empty, since when, and which are played by a second process."""

    patience_s: float = 0.0
    """How long a place is kept; 0 keeps none."""
    empty: dict[str, tuple[float, str]] = field(default_factory=dict)
    """When [s] each was left, and how."""
    taken: set[str] = field(default_factory=set)
    """Roles that another process plays than the one that began: what became of that one does not count any more."""

    def keeps(self, role: str) -> bool:
        """Whether the role's place is kept when its process goes."""
        return self.patience_s > 0 and role in ROLES

    def leave(self, role: str, how: str) -> bool:
        """Notes that a process is gone; whether that is news."""
        if role in self.empty:
            return False
        self.empty[role] = (monotonic(), how)
        return True

    def take(self, role: str) -> bool:
        """Notes that a process speaks for the role; whether the place was empty."""
        if role not in self.empty:
            return False
        del self.empty[role]
        self.taken.add(role)
        return True

    def expired(self) -> dict[str, str]:
        """The places that nobody took in time, each once, with how they were left."""
        now = monotonic()
        late = {role: how for role, (since, how) in self.empty.items() if now - since > self.patience_s}
        for role in late:
            del self.empty[role]
        return late
