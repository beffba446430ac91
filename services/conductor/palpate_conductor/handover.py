"""Slots: in a wall-clock run another process may replace that of a service.

Only for the camera, whose absence is safe and whose work another process can continue. A run ends without the roles that move the
arm, measure or supervise. Perception has the first scan, and the assessment that scan's surface and all samples.
"""

from dataclasses import dataclass, field
from time import monotonic

REPLACEABLE = frozenset({"camera"})


@dataclass
class Slots:
    """Roles whose process left, and roles that a replacement has."""

    patience_s: float = 0.0
    """Time for which a slot is kept; 0 keeps none."""
    empty: dict[str, tuple[float, str]] = field(default_factory=dict)
    """Roles without a process: time [s] at which it left, and how."""
    replaced: set[str] = field(default_factory=set)
    """Roles of a replacement. The end of their first process is ignored."""

    def keeps(self, role: str) -> bool:
        """Return True if the slot of `role` is kept when its process leaves."""
        return self.patience_s > 0 and role in REPLACEABLE

    def leave(self, role: str, how: str) -> bool:
        """Mark a slot empty; return False if it was empty."""
        if role in self.empty:
            return False
        self.empty[role] = (monotonic(), how)
        return True

    def fill(self, role: str) -> bool:
        """Mark a slot filled after a report of `role`; return False if it was not empty."""
        if role not in self.empty:
            return False
        del self.empty[role]
        self.replaced.add(role)
        return True

    def remove_expired(self) -> dict[str, str]:
        """Remove and return the slots that were not filled in time, with how each process left."""
        now = monotonic()
        late = {role: how for role, (since, how) in self.empty.items() if now - since > self.patience_s}
        for role in late:
            del self.empty[role]
        return late
