"""Search service: samples in, next press out, until the budget is spent or a missed lump is improbable."""

from collections.abc import Mapping
from typing import Any, ClassVar, Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from palpate_assessment.shapes import Bump
from palpate_bus.contract import contract
from palpate_bus.messages import NS, ExamState, Message, Point, SearchRequest, header, nanoseconds
from palpate_bus.service import Inbox, Outbox, Service
from palpate_models.numerics.frames import Array
from palpate_models.scenario.load import exam_input
from palpate_models.scenario.schema import Scenario
from palpate_plugins import PluginError
from palpate_search.posterior import Budget, Policy, Posterior, Press, Task, policy

FRAME: Final = contract().topics["assessment/map"].frame or ""
PALPATING: Final = frozenset({ExamState.PHASE_INDENT, ExamState.PHASE_SCAN, ExamState.PHASE_RETRACT})


class SearchTuning(NamedTuple):
    """Numbers of presses, and tolerances."""

    min_uncertainty_m: float = 0.0002
    """Lower bound of the depth SD."""
    reached_m: float = 0.005
    """A requested place counts as out of reach if no press came nearer than this."""
    outline_presses: int = 6
    """Presses around a lump that was found."""
    rounded_m: float = 1e-9
    min_presses: int = 12
    """Minimum number of presses: with fewer the assessment has no result."""


TUNING = SearchTuning()


class SearchService(Service):
    """Requests one press at a time, from the first palpation on, each when the previous one is finished."""

    role: ClassVar[str] = "search"

    def __init__(self, scenario: Scenario) -> None:
        """Raise PluginError for an unknown policy."""
        self._posterior = Posterior(Task.of(exam_input(scenario)))
        self._policy = policy(scenario.search.policy)
        self._missed = scenario.search.missed
        self._begin: int | None = None
        """Time of the first request [ns]."""
        self._number = self._earlier = 0
        """Requests, and presses of the examination that this one resumed."""
        self._asked: Array | None = None
        """Place of the latest request [m], shape (2,)."""
        self._outline: list[Array] = []
        """Remaining presses around lumps that were found."""
        self._felt: list[Press] = []
        """Samples since the latest request."""
        self._spent_s = 0.0
        """Time from the first request to the latest."""
        self._ended = ""

    def step(self, t: int, inbox: Inbox) -> Outbox:
        """Send a request when the examination is ready for one."""
        self._felt += [_press(sample) for sample in inbox.new("assessment/samples")]
        state = inbox.latest("exam/state")
        if state is not None and state.patient_moved:  # samples since the last request may be misplaced
            self._felt.clear()
            self._asked = None
        if state is None or state.phase not in PALPATING or self._ended or state.target_index != self._number:
            return {}
        if self._begin is None:
            self._begin, self._earlier = t, len({press.stroke for press in self._felt})
        for press in {press.stroke: press for press in self._felt}.values():  # a gated press has several samples
            self._posterior.add(press)
        if self._asked is not None and not self._felt:
            self._posterior.vain += 1
        if self._asked is not None and not any(np.linalg.norm(press.xy - self._asked) < TUNING.reached_m for press in self._felt):
            self._posterior.refuse(self._asked)
        self._felt.clear()
        while (lump := self._posterior.found) is not None:
            self._posterior = self._posterior.accept(lump)
            self._outline += outline(lump, self._posterior)
        self._number += 1
        self._spent_s = (t - self._begin) / NS
        return {"exam/request": self._request(t)}

    def finish(self) -> Mapping[str, Any]:
        """Return counts of requests and presses, found lumps, and the reason for the end."""
        return {
            "requests": self._number,
            "presses": len(self._posterior.presses),
            "seconds": round(self._spent_s, 2),
            "found_m": [[round(bump.x, 4), round(bump.y, 4)] for bump in self._posterior.accepted],
            "missed": round(self._posterior.lump, 4),
            "ended": self._ended or "with the examination",
        }

    def _request(self, t: int) -> Message:
        posterior = self._posterior
        self._ended = self._over()
        if self._ended:
            place, depth = np.zeros(2), 0.0
        elif self._outline:
            place, depth = self._outline.pop(0), posterior.task.depth
        else:
            place, depth = next_press(self._policy, posterior, posterior.remaining(self._spent_s))
        self._asked = np.asarray(place, dtype=float)
        kind, x, y = SearchRequest.DONE if self._ended else SearchRequest.PRESS, float(place[0]), float(place[1])
        point = Point(x, y, 0.0)
        return SearchRequest(header(t, FRAME), self._number, kind, point, float(depth), posterior.lump, self._ended)

    def _over(self) -> str:
        """Return the reason for the end; empty while the search continues."""
        posterior, left = self._posterior, self._posterior.remaining(self._spent_s)
        if posterior.lump < self._missed and not self._outline and len(posterior.presses) >= TUNING.min_presses:
            return f"the probability of a missed lump is {100 * posterior.lump:.1f} %"
        if self._number + self._earlier > posterior.task.budget.presses:
            return f"{posterior.task.budget.presses} presses made"
        if left.seconds <= 0:
            return f"{posterior.task.budget.seconds:g} s elapsed"
        return ""


def try_policy(scenario: Scenario) -> None:
    """Ask the scenario's policy for a first press. Raises PluginError if that is not usable."""
    posterior = Posterior(Task.of(exam_input(scenario)))
    next_press(policy(scenario.search.policy), posterior, posterior.remaining(0.0))


def next_press(chosen: Policy, posterior: Posterior, left: Budget) -> tuple[Array, float]:
    """Return the place [m] and depth [m] that a policy requests. Raises PluginError unless it is a press in the allowed range."""
    asked: Any = chosen(posterior, left)
    try:
        place, depth = asked
        return check_request(place, float(depth), posterior.task)
    except (TypeError, ValueError) as error:
        raise PluginError(f"search.policy: returned {asked!r}, expected (place, depth): (x, y) [m] and a number [m]") from error


def check_request(place: ArrayLike, depth: float, task: Task) -> tuple[Array, float]:
    """Return the place [m] and depth [m] requested by a policy. Raises PluginError outside the allowed range."""
    xy, rounded = np.asarray(place, dtype=float), TUNING.rounded_m
    if xy.shape != (2,) or not np.all((xy >= task.low - rounded) & (xy <= task.high + rounded)):  # also rejects NaN
        raise PluginError(f"search.policy: requested place {xy} m; allowed: {task.low} to {task.high} m")
    if not 0 < depth <= task.deepest + rounded:
        raise PluginError(f"search.policy: requested depth {depth} m; allowed: above 0, at most {task.deepest} m")
    return xy, depth


def outline(lump: Bump, posterior: Posterior) -> list[Array]:
    """Return presses that outline a lump for the assessment: its centre and places around it [m], shape (2,) each.

    Places outside the region, or already pressed, are omitted.
    """
    angles = 2 * np.pi * np.arange(TUNING.outline_presses) / TUNING.outline_presses
    about = np.array((lump.x, lump.y)) + lump.radius * np.column_stack((np.cos(angles), np.sin(angles)))
    places = np.vstack(((lump.x, lump.y), about))
    task, pressed = posterior.task, np.array([press.xy for press in posterior.presses])
    inside = np.all((places >= task.low) & (places <= task.high), axis=1)
    apart = np.linalg.norm(places[:, None] - pressed, axis=2).min(axis=1)
    return list(places[inside & (apart > TUNING.reached_m)])


def _press(sample: Message) -> Press:
    x, y, t = sample.position.x, sample.position.y, nanoseconds(sample.header.stamp) / NS
    sd, stroke = max(sample.depth_uncertainty, TUNING.min_uncertainty_m), int(sample.stroke)
    limited = sample.force_limited
    return Press(x, y, sample.depth, sample.normal_force, t, limited=limited, depth_uncertainty=sd, stroke=stroke)


def create(scenario: Scenario) -> Service:
    """Return the search of a scenario; it uses the examination's view only."""
    return SearchService(scenario)
