"""Presses that a search requests, appended to the strokes one at a time."""

from palpate_models.numerics.frames import Array
from palpate_planning.free_motion import PLANNING_TIME, BackgroundTask
from palpate_planning.palpation import Palpation
from palpate_planning.reasons import FOR_PLAN
from palpate_planning.strokes.plan import PressPlanner, PressRequest, Segment


class RequestedPresses:
    """The presses that a search requests, planned one at a time on the worker thread."""

    def __init__(self, *, lockstep: bool) -> None:
        self._lockstep = lockstep
        self._request: PressRequest | None = None
        self._planned: PressRequest | None = None
        """The request that is being planned or carried out."""
        self._planning: BackgroundTask[tuple[Segment, ...]] | None = None
        self.done = 0
        """Number of the latest request that was carried out, or found to be impossible."""

    def receive(self, request: PressRequest | None) -> None:
        """Keep a request until the arm can carry it out: the search asks once."""
        self._request = request or self._request

    def drop_plan(self) -> None:
        """Drop a press that is being planned on an outdated surface; it is planned again on the next one."""
        if self._planning is not None:
            self._request, self._planning = self._request or self._planned, None

    def step(self, t: int, presses: PressPlanner, palpation: Palpation, shift_A: Array) -> None:
        """Plan the next press at `t` [ns], or append it to the strokes."""
        if self._request is not None:
            self._planned, self._request = self._request, None
            request = self._planned.shift_by(shift_A)
            if request.xy is None:
                palpation.more = False
            else:
                self._planning = BackgroundTask(t, PLANNING_TIME, lambda: presses.press(request), lockstep=self._lockstep)
        elif self._planning is not None and self._planning.due(t):
            palpation.extend(self._planning.result())
            self._planning = None
        elif self._planning is not None and self._planning.late(t):
            self._planning = None
            palpation.leave(FOR_PLAN.end)
        elif self._planning is None and self._planned is not None and palpation.waiting:
            self.done = self._planned.number
