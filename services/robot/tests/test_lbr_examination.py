"""A whole examination on the emulated arm, every other service as it is, in simulated time."""

from __future__ import annotations

import numpy as np
import pytest
from lbr_bench import driver_on_emulator

from palpate.run.composed import load_services
from palpate_bus.messages.stamps import nanoseconds
from palpate_bus.runtime.composed import Composed
from palpate_conductor.collector import Collector
from palpate_models.scenario.load import load_scenario, seen

OTHERS = ("tissue", "control", "planning", "supervisor", "assessment", "camera", "perception")
SHORT = ("exam.region_m=[0.03,0.03]", "exam.centre_m=[-0.055,-0.055]", "camera.frames=2")


@pytest.mark.slow
@pytest.mark.parametrize("level", ["torque", "setpoint"])
@pytest.mark.parametrize("gravity_error_nm", [0.0, 0.5])
def test_an_examination_completes(level: str, gravity_error_nm: float) -> None:
    scenario = load_scenario("clean", SHORT)
    robot, port = driver_on_emulator(seen(scenario, "plant"), level, gravity_error_nm=gravity_error_nm)
    collector = Collector()
    run = Composed([robot, *load_services(scenario, OTHERS), collector])
    run.run(lambda: collector.collected.end_tick, 40_000_000_000)
    facts = run.finish()
    assert facts["planning"]["message"] == "examination complete"
    assert facts["robot"]["holds"] == []
    assert facts["supervisor"]["stops"] == []
    assert facts["robot"]["level"] == level
    assert port.emulator.session.ended == ""
    true = {nanoseconds(m.header.stamp): m.depth for m in collector.collected.indentation}
    states = [s for s in collector.collected.exam_states if s.steady and nanoseconds(s.header.stamp) in true]
    errors = np.array([true[nanoseconds(s.header.stamp)] - s.depth_setpoint for s in states])
    assert len(errors) > 100
    assert np.sqrt(np.mean(errors**2)) < 1e-3
