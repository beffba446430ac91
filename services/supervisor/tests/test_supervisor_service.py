"""The supervisor with messages that are no good."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from palpate_bus.messages import SupervisorState, SurfaceMesh
from palpate_bus.messages.stamps import header
from palpate_bus.testing.hand_inbox import HandInbox
from palpate_models.load import load_scenario
from palpate_supervisor.service import create


@pytest.mark.parametrize(("vertices", "normals"), [(4, 6), (6, 5), (6, 9), (9, 6)])
def test_a_surface_that_is_none_stops_softly_and_ends_nobody(vertices: int, normals: int) -> None:
    mesh = SurfaceMesh(
        header(0), np.zeros(vertices, np.float32), np.zeros(normals, np.float32), np.zeros(0, np.uint32), np.empty(0, np.float32)
    )
    inbox = HandInbox()
    inbox.events["perception/surface"] = [mesh]
    state: Any = create(load_scenario("healthy")).step(0, inbox)["supervisor/state"]
    assert (state.level, state.cause) == (SupervisorState.LEVEL_SOFT_STOP, SupervisorState.CAUSE_INVALID)
    assert "perception/surface" in state.reason
