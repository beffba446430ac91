"""The supervisor with messages that are invalid."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from palpate_bus.messages import OperatorRequest, RobotStatus, SupervisorState, SurfaceMesh, Vector3, Wrench
from palpate_bus.messages.stamps import header
from palpate_bus.testing.hand_inbox import HandInbox
from palpate_models.numerics.frames import GRAVITY
from palpate_models.robot import lbr
from palpate_models.scenario.load import load_scenario
from palpate_supervisor.service import TUNING, SupervisorService, create

MS = 1_000_000


def status(stamp: int, force: float) -> RobotStatus:
    """The arm stands, with a force that presses the tool up."""
    weight = load_scenario("healthy").robot.tool_mass_kg * GRAVITY
    wrench = Wrench(Vector3(0.0, 0.0, weight + force), Vector3(0.0, 0.0, 0.0))
    return RobotStatus(header(stamp), 1, 0, "", np.array(lbr.HOME), np.zeros(7), wrench, np.zeros(7), 0, "")


def after(service: SupervisorService, t: int, **messages: Any) -> Any:
    """The state after a step at `t` [ns] in which the messages come."""
    inbox = HandInbox()
    for topic, message in messages.items():
        inbox.events[topic.replace("__", "/")] = [message]
        inbox.messages[topic.replace("__", "/")] = message
    return service.step(t, inbox)["supervisor/state"]


def test_a_request_that_is_unknown_is_a_stop_and_no_release() -> None:
    service = create(load_scenario("healthy"))
    after(service, 0, operator__request=OperatorRequest(header(0), OperatorRequest.STOP, "enough"))
    state = after(service, 10 * MS, operator__request=OperatorRequest(header(0), 200, "damaged"))
    assert (state.level, state.releases) == (SupervisorState.LEVEL_EMERGENCY, 0)


def test_what_was_measured_stands_until_it_is_measured_again() -> None:
    """A release on a tick on which no status has come is refused as on any other."""
    service = create(load_scenario("healthy"))
    for n in range(3):
        after(service, n * 10 * MS, robot__status=status(n * 10 * MS, 0.0 if n < 2 else 45.0))
    state = after(service, 30 * MS, operator__request=OperatorRequest(header(0), OperatorRequest.RELEASE, ""))
    assert (state.level, state.releases) == (SupervisorState.LEVEL_EMERGENCY, 0)


def test_a_measurement_that_is_only_repeated_is_silence() -> None:
    service = create(load_scenario("healthy"))
    state = None
    for t in range(0, TUNING.settle_ns, 10 * MS):
        state = after(service, t, robot__status=status(0, 0.0))
    assert (state.level, state.cause) == (SupervisorState.LEVEL_EMERGENCY, SupervisorState.CAUSE_SILENT)


@pytest.mark.parametrize(("vertices", "normals"), [(4, 6), (6, 5), (6, 9), (9, 6)])
def test_an_invalid_surface_stops_softly_and_ends_no_process(vertices: int, normals: int) -> None:
    mesh = SurfaceMesh(
        header(0), np.zeros(vertices, np.float32), np.zeros(normals, np.float32), np.zeros(0, np.uint32), np.empty(0, np.float32)
    )
    inbox = HandInbox()
    inbox.events["perception/surface"] = [mesh]
    state: Any = create(load_scenario("healthy")).step(0, inbox)["supervisor/state"]
    assert (state.level, state.cause) == (SupervisorState.LEVEL_SOFT_STOP, SupervisorState.CAUSE_INVALID)
    assert "perception/surface" in state.reason


def test_without_the_assessment_planning_has_time_to_retreat() -> None:
    """Its loss stands for good: that says nothing of whether the arm retreats."""
    service, state = create(load_scenario("healthy")), None
    inbox = HandInbox()
    inbox.gone.add("assessment")
    for t in range(0, TUNING.settle_ns, 10 * MS):
        state = service.step(t, inbox)["supervisor/state"]
    assert (state.level, state.cause) == (SupervisorState.LEVEL_SOFT_STOP, SupervisorState.CAUSE_LOST)
    state = service.step(5000 * MS, inbox)["supervisor/state"]
    assert state.level == SupervisorState.LEVEL_EMERGENCY, "but not for ever"
