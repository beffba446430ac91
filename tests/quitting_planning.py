"""Planning that aborts the examination after a second, for `palpate run --service planning=FILE`."""

import dataclasses
from typing import Any

from palpate_bus.messages import ExamState
from palpate_bus.service import Inbox, Outbox
from palpate_models.scenario.load import exam_input
from palpate_models.scenario.schema import Scenario
from palpate_planning.service import PlanningService

MS = 1_000_000


class Quitting(PlanningService):
    """Planning whose phase is always aborted."""

    end: int | None = None

    def step(self, t: int, inbox: Inbox) -> Outbox:
        out: dict[str, Any] = dict(super().step(t, inbox))
        self.end = t + 1000 * MS if self.end is None else self.end
        given_up = {"phase": ExamState.PHASE_ABORTED, "message": "aborted in phase HOME: enough", "end_tick": self.end}
        out["exam/state"] = dataclasses.replace(out["exam/state"], **given_up)
        return out


def create(scenario: Scenario) -> Quitting:
    return Quitting(exam_input(scenario))
