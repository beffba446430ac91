"""The supervisor with messages that are no good."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from palpate_bus.messages import SupervisorState, SurfaceMesh
from palpate_bus.stamps import header
from palpate_models.load import load_scenario
from palpate_supervisor.service import create


class OneMessage:
    """An inbox with one new message."""

    def __init__(self, topic: str, message: Any) -> None:
        self._topic, self._message = topic, message

    def latest(self, topic: str) -> Any:
        return self._message if topic == self._topic else None

    def new(self, topic: str) -> list[Any]:
        return [self._message] if topic == self._topic else []

    def stamp(self, topic: str) -> int | None:
        return 0 if topic == self._topic else None

    def lost(self, role: str) -> bool:
        return False


@pytest.mark.parametrize(("vertices", "normals"), [(4, 6), (6, 5), (6, 9), (9, 6)])
def test_a_surface_that_is_none_stops_softly_and_ends_nobody(vertices: int, normals: int) -> None:
    mesh = SurfaceMesh(header(0), np.zeros(vertices, np.float32), np.zeros(normals, np.float32), np.zeros(0, np.uint32))
    state: Any = create(load_scenario("healthy")).step(0, OneMessage("perception/surface", mesh))["supervisor/state"]
    assert (state.level, state.cause) == (SupervisorState.LEVEL_SOFT_STOP, SupervisorState.CAUSE_INVALID)
    assert "perception/surface" in state.reason
