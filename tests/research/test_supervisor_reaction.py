"""The supervisor stops the arm after every fault of planning and other services, in simulated time."""

import pytest

from palpate_bus.messages import SupervisorState
from research.supervisor_reaction import CASES, react


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_every_fault_stops_the_arm(name: str) -> None:
    reaction = react(name)
    assert reaction.causes[0] == CASES[name].cause, reaction.reason
    assert reaction.peak_force < 25.0, reaction
    assert reaction.to_hold < 300.0 or CASES[name].cause == SupervisorState.CAUSE_WORKSPACE, reaction
    assert reaction.speed_after < 0.02
