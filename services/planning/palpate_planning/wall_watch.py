"""Whether the wall can be palpated now: what a cough, a deep breath, a patient who moves and a skin that is gone call for."""

from __future__ import annotations

from palpate_models.scenario.schema import Following
from palpate_planning.wall.breath import Breath

CALM_S = 1.0
"""After a cough or a deep breath the skin is left alone until the wall has been followed well for so long."""
CALM_PATIENCE_S = 60.0
"""A wall that cannot be followed for so long ends the strokes."""
HIDDEN_MAX_S = 5.0
"""An arm that hides the wall from the camera for so long, and no longer knows how it breathes, goes elsewhere. A deep breath or a
cough, after which nothing may be seen either, is over by then."""
LOST_S = 0.3
"""Without contact at depth for so long, the wall is not where it was touched: it is touched anew."""
LOST_MAX = 5
"""With this many losses of contact the strokes end."""
SHUT_MAX_S = 15.0
"""When breathing is gated, and for so long it was never near the end of expiration, nothing waits for that in contact."""
GATE_M = 0.001
"""So far from the end of expiration, where the wall moves most, samples are taken when breathing is gated."""


class WallWatch:
    """Judges the breath that is followed and the contact; one `step` each planning period."""

    def __init__(self, breath: Breath, following: Following, period_s: float) -> None:
        self._breath, self._gated, self._period_s = breath, following is Following.GATE, period_s
        self._calm_for, self._restless_for, self._adrift_for, self._hidden_for, self._shut_for = CALM_S, 0.0, 0.0, 0.0, 0.0
        """For how long the wall was followed well, since when it was not for long enough, for how long there was no contact at
        depth, for how long it was not followed because it was not seen, and since when samples may not be taken [s]."""
        self._losses = 0
        self.spoiled = False
        """Whether what is measured now is worth nothing: the indenter has to lift off."""
        self.leaps = False
        """Whether the wall is seen to do what was not expected: where it will be next is not known."""
        self.open = True
        """Whether samples may be taken at this moment of the breath."""
        self.moved = False
        """Whether the patient has moved."""
        self.ended = ""
        """Why the strokes have to end; empty while they need not."""

    @property
    def calm(self) -> bool:
        """Whether the wall has been followed well for long enough to touch it."""
        return self._calm_for >= CALM_S

    @property
    def hidden(self) -> bool:
        """Whether the wall has been hidden for too long to wait where the arm is."""
        return self._hidden_for > HIDDEN_MAX_S

    def step(self, t: int, *, adrift: bool, leaving: bool = False) -> None:
        """Judges the moment `t` [ns]; `adrift`: at depth, and yet nothing is felt; `leaving`: the arm is on a free motion."""
        breath, dt = self._breath, self._period_s
        self.open = not self._gated or abs(breath.displacement(t)) < GATE_M
        self._shut_for = 0.0 if self.open else self._shut_for + dt
        followed = breath.calm(t)
        calm = followed and self._shut_for <= SHUT_MAX_S
        self._calm_for = self._calm_for + dt if calm else 0.0
        self._restless_for = 0.0 if self.calm else self._restless_for + dt
        self._hidden_for = self._hidden_for + dt if breath.hidden and not followed and not leaving else 0.0
        self._adrift_for = self._adrift_for + dt if adrift else 0.0
        lost = self._adrift_for > LOST_S
        if lost:
            self._losses, self._adrift_for = self._losses + 1, 0.0
        self.spoiled = lost or not calm
        self.leaps = not (followed or breath.hidden)
        self.moved = self.moved or breath.moved
        if self.moved:
            self.ended = "the patient has moved"
        elif self._restless_for > CALM_PATIENCE_S:
            self.ended = f"the wall could not be followed for {CALM_PATIENCE_S:g} s"
        elif self._losses >= LOST_MAX:
            self.ended = f"contact was lost {self._losses} times"
