"""The service asks for one press after the other, and says when it is over."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from palpate.check.report import ConformanceReport
from palpate.check.rig import RigSettings, ServiceRig
from palpate.check.suites.search import LUMP, REQUEST, Play, pressed, suite
from palpate_bus.messages import ExamState, Point, SearchRequest
from palpate_models.scenario.schema import Exam, Scenario, Search, SearchBudget
from palpate_plugins import PluginError
from palpate_search.presses import Task
from palpate_search.service import TUNING, checked, create


def played(**exam: Any) -> tuple[ServiceRig, ConformanceReport]:
    """The conformance suite's examination, of a small region."""
    scenario = Scenario(exam=Exam(region_m=(0.1, 0.1), pattern="search", **exam))
    rig, report = ServiceRig(create(scenario), RigSettings(scenario)), ConformanceReport("search")
    suite(rig, report)
    return rig, report


def test_it_finds_the_stiff_area_and_ends() -> None:
    rig, report = played()
    assert report.passed
    requests = [item.message for item in rig.log[REQUEST]]
    assert requests[-1].request == SearchRequest.DONE
    assert requests[-1].lump < Search().missed
    assert TUNING.fewest_presses < len(requests) < 40
    places = np.array([(message.place.x, message.place.y) for message in requests[:-1]])
    assert (np.linalg.norm(places - 0.02, axis=1) < 0.025).sum() >= 3


def test_it_keeps_to_the_budget_of_presses() -> None:
    rig, report = played(budget=SearchBudget(presses=5))
    assert report.passed
    assert [item.message.request for item in rig.log[REQUEST]] == [SearchRequest.PRESS] * 5 + [SearchRequest.DONE]
    assert "5 presses made" in rig.last(REQUEST).reason


def test_it_keeps_to_the_budget_of_time() -> None:
    rig, _ = played(budget=SearchBudget(seconds=2.0))
    assert rig.last(REQUEST).request == SearchRequest.DONE
    assert rig.last(REQUEST).reason == "2 s elapsed"


@pytest.mark.parametrize("phase", [ExamState.PHASE_HELD, ExamState.PHASE_ASSESS])
def test_no_request_before_palpation(phase: int) -> None:
    scenario = Scenario(exam=Exam(region_m=(0.1, 0.1), pattern="search"))
    rig, play = ServiceRig(create(scenario), RigSettings(scenario)), Play()
    play.phase = phase
    rig.run(0.3, {"exam/state": play.state})
    assert not rig.log[REQUEST]


def test_a_place_that_the_arm_cannot_take_is_not_asked_for_again() -> None:
    scenario = Scenario(exam=Exam(region_m=(0.1, 0.1), pattern="search", budget=SearchBudget(presses=12)))
    rig, play = ServiceRig(create(scenario), RigSettings(scenario)), Play()
    play.phase = ExamState.PHASE_RETRACT
    rig.run(0.3, {"exam/state": play.state})
    for _ in range(12):
        asked = rig.last(REQUEST)
        elsewhere = SimpleNamespace(place=Point(0.04, 0.04, 0.0), depth=asked.depth)
        rig.send("assessment/samples", pressed(rig.t, elsewhere, np.zeros(2)))
        play.over = int(asked.number)
        rig.run(0.3, {"exam/state": play.state})
    places = [(m.place.x, m.place.y) for m in (item.message for item in rig.log[REQUEST]) if m.request == SearchRequest.PRESS]
    assert len(set(places)) == len(places) == 12


@pytest.mark.parametrize("policy", ["informed", "raster", "random", "latin-hypercube", "expected-improvement"])
def test_a_press_that_gave_no_sample_is_over_too(policy: str) -> None:
    scenario = Scenario(exam=Exam(region_m=(0.1, 0.1), pattern="search"), search=Search(policy=policy))
    rig, play = ServiceRig(create(scenario), RigSettings(scenario)), Play()
    play.phase = ExamState.PHASE_RETRACT
    for _ in range(4):
        rig.run(0.3, {"exam/state": play.state})
        play.over = int(rig.last(REQUEST).number)
    assert len({(item.message.place.x, item.message.place.y) for item in rig.log[REQUEST]}) == 4


TASK = Task((0.0, 0.0), (0.1, 0.1))


@pytest.mark.parametrize(
    ("place", "depth", "named"),
    [
        ((0.14, 0.0), 0.010, "place"),
        ((float("nan"), 0.0), 0.010, "place"),
        ((0.0, 0.0, 0.0), 0.010, "place"),
        ((0.0, 0.0), 10.0, "depth"),
        ((0.0, 0.0), float("nan"), "depth"),
        ((0.0, 0.0), 0.0, "depth"),
    ],
)
def test_what_the_arm_must_not_press_is_refused(place: tuple[float, ...], depth: float, named: str) -> None:
    with pytest.raises(PluginError, match=named):
        checked(np.array(place), depth, TASK)


def test_the_edge_of_the_region_and_the_greatest_depth_may_be_pressed() -> None:
    assert checked(TASK.high, TASK.deepest, TASK)[1] == TASK.deepest


def test_the_report_says_what_it_took() -> None:
    scenario = Scenario(exam=Exam(region_m=(0.1, 0.1), pattern="search", budget=SearchBudget(presses=5)))
    service = create(scenario)
    suite(ServiceRig(service, RigSettings(scenario)), ConformanceReport("search"))
    facts = service.finish()
    assert facts["presses"] == 5
    assert 4 * LUMP.press_s <= facts["seconds"] <= 6 * LUMP.press_s + 0.5
    assert facts["ended"] == "5 presses made"
