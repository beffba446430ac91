"""Role search: the suite plays an examination that carries out each request, on a belly with one stiff area."""

from typing import Any, Final

import numpy as np

from palpate.check.rig import Rig
from palpate.check.suites.assessment import BELLY, stiffness
from palpate.exam_state import exam_state
from palpate_bus.messages import ExamState, Message, PalpationSample, Point, SearchRequest, Vector3, header

REQUEST: Final = "exam/request"
PRESS_S: Final = 0.3
MAX_PRESSES: Final = 40


class Play:
    """States of an examination; `over` is the number of the latest finished request."""

    def __init__(self) -> None:
        self.phase, self.over = ExamState.PHASE_PLAN, 0

    def state(self, t: int) -> Any:
        """Return the state at `t` [ns]."""
        depth: dict[str, Any] = {"depth_setpoint": -0.01, "depth": -0.01, "depth_uncertainty": 0.0005}
        return exam_state(t, self.phase, target_index=self.over, stroke=self.over, **depth)


def suite(rig: Rig) -> None:
    """Check silence before contact, one request at a time, places in the region, and an end within the budget."""
    exam = rig.settings.scenario.exam
    stiff_at = np.array(exam.centre_m) + 0.2 * np.array(exam.region_m)
    play = Play()
    rig.section("requests")
    rig.run(0.2, {"exam/state": play.state})
    rig.equal("requests nothing before contact", len(rig.log[REQUEST]), 0)
    play.phase = ExamState.PHASE_RETRACT
    rig.run(0.5, {"exam/state": play.state})
    rig.equal("requests once and waits", len(rig.log[REQUEST]), 1)
    early = 0
    while rig.log[REQUEST] and rig.last(REQUEST).request == SearchRequest.PRESS and play.over < MAX_PRESSES:
        asked = rig.last(REQUEST)
        if asked.number <= play.over:
            break
        rig.send("assessment/samples", press_belly(rig.t, asked, stiff_at))
        early += len(rig.run(PRESS_S / 2, {"exam/state": play.state})[REQUEST])
        play.over = int(asked.number)
        rig.run(PRESS_S / 2, {"exam/state": play.state})
    received = [item.message for item in rig.log[REQUEST]]
    rig.equal("waits until a press is over", early, 0)
    rig.equal("then requests the next", len(received), play.over + 1)
    rig.within("reports the probability of a lump", [message.lump for message in received], 0, 1, "")
    rig.equal("numbers its requests", [int(message.number) for message in received], list(range(1, len(received) + 1)))
    presses = [message for message in received if message.request == SearchRequest.PRESS]
    xy = np.array([(message.place.x, message.place.y) for message in presses]).reshape(-1, 2)
    inside = bool(np.all(np.abs(xy - exam.centre_m) <= 0.5 * np.array(exam.region_m) + 1e-9))
    rig.expect("presses inside the region", inside, f"{exam.region_m} m about {exam.centre_m} m", f"{len(xy)} places")
    depths = [message.depth for message in presses]
    rig.within("presses no deeper than the limit", depths, 1e-6, rig.settings.scenario.limits.depth_m, "m")
    rig.within("keeps to its budget", len(presses), 0, exam.budget.presses, "presses")
    if received and received[-1].request == SearchRequest.DONE:
        rig.expect("ends with a reason", bool(received[-1].reason), "a reason", received[-1].reason)
    else:
        rig.skip("an end", f"it continued beyond {len(presses)} presses")


def press_belly(t: int, asked: Any, stiff_at: Any) -> Message:
    """Return the sample of a press of the belly."""
    xy = np.array((asked.place.x, asked.place.y))
    force = BELLY.force_n * stiffness(float(np.linalg.norm(xy - stiff_at))) * (asked.depth / 0.010) ** 1.3
    place = Point(float(xy[0]), float(xy[1]), 0.0)
    up = Vector3(0.0, 0.0, 1.0)
    return PalpationSample(header(t, "abdomen"), place, up, float(asked.depth), float(force), 0.0, 0.5, False, 1, 0.0005)
