"""Emulator and driver as processes see each other: the stack's messages under rmw_zenoh's keys."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from lbr_bench import driver_on_emulator

from palpate.run.composed import load_services
from palpate_bus.messages import ExamState
from palpate_bus.messages.stamps import nanoseconds
from palpate_bus.runtime.composed import Composed
from palpate_conductor.collector import Collector
from palpate_models.robot import lbr
from palpate_models.scenario.load import load_scenario, seen
from palpate_models.scenario.schema import LbrConnection
from palpate_robot.backends.lbr.port import SessionState, ZenohPort


def test_states_come_and_commands_move_the_arm(tmp_path: Path) -> None:
    endpoint = f"unixsock-stream/{tmp_path}/lbr.sock"
    words = [sys.executable, "-m", "palpate_robot.backends.lbr.emulator", "clean", "--listen", endpoint]
    emulator = subprocess.Popen(words, stderr=subprocess.DEVNULL, env={**os.environ, "OMP_NUM_THREADS": "1"})
    port = ZenohPort(LbrConnection(router=endpoint, emulated=True))
    torque = np.zeros(7)
    torque[0] = 6.0
    try:
        seen: set[int] = set()
        moved, wrenches, begin = 0.0, 0, time.monotonic()
        while moved < 0.05 and time.monotonic() - begin < 60.0:
            for state in port.states():
                seen.add(int(state.session_state))
                moved = float(state.measured_joint_position[0] - lbr.HOME[0])
                if state.session_state == SessionState.COMMANDING_ACTIVE:
                    port.command(np.array(state.measured_joint_position), torque)
            wrenches += len(port.wrenches())
            time.sleep(0.001)
        assert moved >= 0.05, f"session states seen: {sorted(seen)}"
        assert SessionState.COMMANDING_ACTIVE in seen
        assert wrenches > 10
    finally:
        port.close()
        emulator.terminate()
        assert emulator.wait(timeout=20) == 0


def test_a_period_that_fri_does_not_have_ends_with_status_2() -> None:
    words = [sys.executable, "-m", "palpate_robot.backends.lbr.emulator", "--period-ms", "0"]
    done = subprocess.run(words, capture_output=True, text=True, timeout=100, check=False)
    assert done.returncode == 2
    assert "whole milliseconds" in done.stderr


OTHERS = ("tissue", "control", "planning", "supervisor", "assessment", "camera", "perception")

SHORT = ("exam.region_m=[0.03,0.03]", "exam.centre_m=[-0.055,-0.055]", "camera.frames=2")


@pytest.mark.slow
@pytest.mark.parametrize("level", ["torque", "setpoint"])
def test_an_examination_completes(level: str) -> None:
    scenario = load_scenario("clean", SHORT)
    robot, port = driver_on_emulator(seen(scenario, "plant"), level, gravity_error_nm=0.5)
    collector = Collector()
    run = Composed([robot, *load_services(scenario, OTHERS), collector])
    run.run(lambda: collector.collected.end_tick, 40_000_000_000)
    facts = run.finish()
    assert collector.collected.exam.phase == ExamState.PHASE_DONE
    assert facts["robot"]["holds"] == []
    assert facts["supervisor"]["stops"] == []
    assert facts["robot"]["level"] == level
    assert port.emulator.session.ended == ""
    true = {nanoseconds(m.header.stamp): m.depth for m in collector.collected.indentation}
    states = [s for s in collector.collected.exam_states if s.steady and nanoseconds(s.header.stamp) in true]
    errors = np.array([true[nanoseconds(s.header.stamp)] - s.depth_setpoint for s in states])
    assert len(errors) > 100
    assert np.sqrt(np.mean(errors**2)) < 1e-3
