"""The driver on an emulated arm without transport and without a wall clock: time is the caller's."""

from __future__ import annotations

from typing import Any

import numpy as np
from palpate_models.load import exam_input
from palpate_models.scenario import Scenario
from palpate_robot_lbr.emulator import Emulator, Options
from palpate_robot_lbr.inner import InnerLoop, load_control
from palpate_robot_lbr.port import LbrPort
from palpate_robot_lbr.service import LbrService
from palpate_robot_lbr.settings import Settings

MS = 1_000_000


class DirectPort(LbrPort):
    """Hands messages over; `states` is called once a millisecond and cycles the emulator when its period has passed."""

    def __init__(self, emulator: Emulator, period_ms: int) -> None:
        self.emulator = emulator
        self.period_ms = period_ms
        self.t = -MS
        self.silent = False
        self.ft_silent = False
        self.torques: list[np.ndarray] = []
        self.commanded_by: list[bytes] = []
        self._readings: list[Any] = []
        self._moved = True

    def states(self) -> list[Any]:
        self.t += MS
        if (self.t // MS) % self.period_ms:
            return []
        if self.t:
            self.emulator.cycle()
        self._moved = True
        self._readings = [] if self.ft_silent else [self.emulator.wrench(self.t)]
        return [] if self.silent or self.emulator.session.ended else [self.emulator.state(self.t)]

    def wrenches(self) -> list[Any]:
        readings, self._readings = self._readings, []
        return readings

    def command(self, q: Any, torque: Any) -> None:
        self.torques.append(np.array(torque))
        self.emulator.session.take(np.array(q), np.array(torque))

    def rivals(self) -> list[bytes]:
        others, self.commanded_by = self.commanded_by, []
        return others

    def contact(self, wrench: Any) -> None:
        f, m = wrench.wrench.force, wrench.wrench.torque
        self.emulator.force_W[:], self.emulator.moment_W[:] = (f.x, f.y, f.z), (m.x, m.y, m.z)

    def physics(self) -> tuple[Any | None, Any | None]:
        moved, self._moved = self._moved, False
        return (self.emulator.tool(self.t), self.emulator.links(self.t)) if moved else (None, None)

    def close(self) -> None:
        pass


def driver_on_emulator(scenario: Scenario, level: str = "torque", **options: Any) -> tuple[LbrService, DirectPort]:
    """Driver and port; options are the emulator's."""
    exam = exam_input(scenario)
    chosen = Options(**options)
    port = DirectPort(Emulator(exam, chosen), chosen.period_ms)
    inner = InnerLoop(load_control(scenario)) if level == "setpoint" else None
    return LbrService(exam, Settings(level=level, emulated=True), port, inner), port
