"""The emulated LBR, its session and pace, and the driver's watchdog, in one process and in several."""

import os
import socket
import subprocess
import sys
import time
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from lbr_bench import MS, Rig, active_rig, driver_on_emulator

from palpate.run.composed import load_services
from palpate_bus.messages import ExamState, RobotStatus, blank, nanoseconds
from palpate_bus.runtime.composed import Composed
from palpate_bus.wire.ros_node import RosNode
from palpate_bus.wire.zenoh_config import BusOptions
from palpate_conductor.collector import Collector
from palpate_models.robot import lbr
from palpate_models.scenario.load import load_scenario, plant_input, restrict_to_view
from palpate_models.scenario.schema import RobotDriver
from palpate_robot.backends.emulated import Metronome
from palpate_robot.backends.hardware import TAKE_OVER_NS
from palpate_robot.backends.lbr.emulator import Emulator, FriSession, main
from palpate_robot.backends.lbr.port import TORQUE_COMMAND, LBRTorqueCommand, SessionState, ZenohPort
from palpate_robot.backends.lbr.watchdog import lbr_watchdog
from palpate_robot.backends.watchdog import TIMEOUT_NS, Watchdog

PUSH = np.array([0.0, 12.0, 0.0, 0.0, 0.0, 0.0, 0.0])


def commanding() -> Emulator:
    """Return an arm whose session takes commands."""
    emulator = Emulator(plant_input(load_scenario("clean")))
    while emulator.session.state is not SessionState.COMMANDING_ACTIVE:
        emulator.cycle()
    return emulator


def dead_driver(watched: bool) -> Emulator:
    """Return the arm 0.6 s after a driver that pushed has died."""
    emulator, watchdog = commanding(), lbr_watchdog()
    for t in range(0, 800 * MS, 2 * MS):
        watchdog.state(t, emulator.state(1 + t))
        if t < 200 * MS:
            emulator.session.take(emulator.measured, PUSH)
            watchdog.command(t, b"driver")
        answer = watchdog.decide(t)
        if answer is not None and watched:
            emulator.session.take(*answer)
        emulator.cycle()
    return emulator


def test_without_it_the_arm_goes_on_and_with_it_it_stands() -> None:
    alone, watched = dead_driver(False), dead_driver(True)
    assert "command guard" in alone.session.ended, "it runs into the stack's last line of defence"
    assert not watched.session.ended
    assert np.abs(watched._plant.v).max() < 0.05
    assert np.abs(watched.measured - lbr.HOME).max() < np.abs(alone.measured - lbr.HOME).max() - 0.05


def started() -> Watchdog:
    watchdog = lbr_watchdog()
    emulator = commanding()
    watchdog.state(0, emulator.state(1))
    watchdog.command(0, b"first")
    return watchdog


def test_it_waits_for_the_time_out_and_no_longer_and_keeps_out_before_anything_was_commanded() -> None:
    assert [started().decide(TIMEOUT_NS + late) is not None for late in (0, MS)] == [False, True]
    assert lbr_watchdog().decide(10 * TIMEOUT_NS) is None


def test_the_old_driver_does_not_get_the_arm_back_a_new_one_does() -> None:
    watchdog = started()
    assert watchdog.decide(2 * TIMEOUT_NS) is not None
    for driver, watched in ((b"first", True), (b"second", False)):
        watchdog.command(2 * TIMEOUT_NS, driver)
        assert (watchdog.decide(2 * TIMEOUT_NS) is not None) is watched


def test_a_driver_that_died_before_the_watchdog_began_leaves_no_push() -> None:
    watchdog, emulator = lbr_watchdog(), commanding()
    for t in range(0, TIMEOUT_NS + 3 * MS, 2 * MS):
        watchdog.state(t, emulator.state(1 + t))
    assert watchdog.decide(TIMEOUT_NS + 3 * MS) is not None


def test_an_old_speed_is_not_damped() -> None:
    watchdog = started()
    watchdog._arm.v[:] = 0.5
    answer = watchdog.decide(10 * TIMEOUT_NS)
    assert answer is not None
    assert not answer[1].any()


@pytest.fixture
def rig() -> Rig:
    return active_rig()


def test_a_driver_that_wakes_and_hears_the_watchdog_holds_and_a_release_lasts_only_without_it(rig: Rig) -> None:
    rig.port.commanded_by = [b"watchdog"] * 16
    rig.tick(20)
    assert (rig.status.mode, rig.status.cause) == (RobotStatus.MODE_SAFE_HOLD, RobotStatus.CAUSE_DEVICE)
    assert np.abs(rig.port.torques[-1]).max() < 0.5, "damping alone"
    rig.inbox.events["supervisor/state"] = [replace(blank("palpation_msgs/msg/SupervisorState", rig.t), releases=1)]
    rig.tick(20)
    assert rig.status.mode == RobotStatus.MODE_ACTIVE
    rig.port.commanded_by = [b"watchdog"]
    rig.tick(20)
    assert rig.status.mode == RobotStatus.MODE_SAFE_HOLD


def received(port: Any, count: int) -> list[bytes]:
    found: list[bytes] = []
    begin = time.monotonic()
    while len(found) < count and time.monotonic() - begin < 20.0:
        found += port()
        time.sleep(0.005)
    return found


def test_over_zenoh_every_command_has_its_sender(tmp_path: Path) -> None:
    endpoint = f"unixsock-stream/{tmp_path}/lbr.sock"
    node = RosNode("watchdog", 0, BusOptions(listen=(endpoint,)))
    topic, command = "lbr/command/torque", LBRTorqueCommand(np.zeros(7), np.zeros(7))
    commands = node.subscription(topic, TORQUE_COMMAND)
    watchdog, new = node.publisher(topic, TORQUE_COMMAND), node.publisher(topic, TORQUE_COMMAND)
    port = ZenohPort(RobotDriver(router=endpoint))
    try:
        begin = time.monotonic()
        while not (first := port.rivals()) and time.monotonic() - begin < 20.0:
            watchdog.publish(command)
            port.command(np.zeros(7), np.zeros(7))
            time.sleep(0.005)
        assert set(first) == {watchdog.gid}, "the port's own commands are not those of another"
        driver = (set(received(lambda: commands.others(watchdog.gid), 1))).pop()
        time.sleep(0.2)
        commands.take()
        for publisher in (watchdog, new, watchdog):
            publisher.publish(command)
        assert received(lambda: commands.others(watchdog.gid), 1) == [new.gid], "not hidden by the newer one of the watchdog"
        assert len({driver, new.gid, watchdog.gid}) == 3
    finally:
        port.close()
        node.close()


def test_states_come_and_commands_move_the_arm(tmp_path: Path) -> None:
    endpoint = f"unixsock-stream/{tmp_path}/lbr.sock"
    words = [sys.executable, "-m", "palpate_robot.backends.lbr.emulator", "clean", "--listen", endpoint]
    emulator = subprocess.Popen(words, stderr=subprocess.DEVNULL, env={**os.environ, "OMP_NUM_THREADS": "1"})
    port = ZenohPort(RobotDriver(router=endpoint, emulated=True))
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


OTHERS = ("tissue", "control", "planning", "supervisor", "assessment", "camera", "perception")

SHORT = ("exam.region_m=[0.03,0.03]", "exam.centre_m=[-0.055,-0.055]", "camera.frames=2")


@pytest.mark.slow
@pytest.mark.parametrize("level", ["torque", "setpoint"])
def test_an_examination_completes(level: str) -> None:
    scenario = load_scenario("clean", SHORT)
    robot, port = driver_on_emulator(restrict_to_view(scenario, "plant"), level, gravity_error_nm=0.5)
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


def test_a_new_driver_takes_over_from_a_watchdog_that_still_commands() -> None:
    rig = Rig()
    for _ in range(TAKE_OVER_NS // MS // 2):
        rig.port.commanded_by = [b"watchdog"]
        rig.tick(1)
    rig.tick(600)
    assert rig.status.mode == RobotStatus.MODE_ACTIVE, rig.status.reason


PERIOD, WALL = 2 * MS, 1_700_000_000_000_000_000


def paced(busy: dict[int, int], cycles: int = 100, rate: float = 1.0) -> tuple[list[int], list[int]]:
    """When cycles begin and their stamps [ns], with a machine that loses `busy[k]` [ns] before cycle k."""
    metronome = Metronome(PERIOD, 0, WALL, rate)
    now, began, stamps = 0, [], []
    for k in range(cycles):
        now += busy.get(k, 0)
        now += metronome.wait(now)
        began.append(now)
        stamps.append(metronome.begin(now))
    return began, stamps


@pytest.mark.parametrize("rate", [1.0, 0.25])
def test_undisturbed_it_keeps_the_period_without_drift(rate: float) -> None:
    began, stamps = paced(dict.fromkeys(range(100), 300000), rate=rate)
    assert began == [PERIOD / rate * (k + 1) for k in range(100)]
    assert stamps == [WALL + round(rate * t) for t in began]


@pytest.mark.parametrize("late", [10 * MS, 90 * MS, 400 * MS])
def test_a_machine_that_stood_still_is_not_made_up_for(late: int) -> None:
    began, stamps = paced({30: late})
    gaps = [b - a for a, b in pairwise(began)]
    assert gaps[29] == late
    assert set(gaps[:29] + gaps[30:]) == {PERIOD}, "no cycle follows on the heels of another"
    assert {b - a for a, b in pairwise(stamps)} == {PERIOD}, "the arm's own clock stood still, too"


def test_an_address_that_is_in_use_is_reported_without_a_traceback(capsys: pytest.CaptureFixture[str]) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        assert main(["clean", "--listen", f"tcp/127.0.0.1:{taken.getsockname()[1]}"]) == 2
    assert "that address is in use" in capsys.readouterr().err


ZERO, HOME = np.zeros(7), np.array(lbr.HOME)


def active() -> FriSession:
    session = FriSession(2, HOME)
    while session.state is not SessionState.COMMANDING_ACTIVE:
        session.cycle(HOME, ZERO)
    return session


def test_states_come_in_order() -> None:
    session = FriSession(2, HOME)
    seen = [session.state]
    for _ in range(500):
        session.cycle(HOME, ZERO)
        if session.state is not seen[-1]:
            seen.append(session.state)
    assert seen == list(SessionState)


@pytest.mark.parametrize("period", [0, 101])
def test_a_period_that_fri_does_not_have_is_refused(period: int) -> None:
    with pytest.raises(ValueError, match="whole milliseconds"):
        FriSession(period, HOME)


def test_commands_before_commanding_are_passed_over_and_later_ones_kept_for_ever() -> None:
    session = FriSession(2, HOME)
    session.take(HOME, np.ones(7))
    assert not session.cycle(HOME, ZERO).torque.any()
    session = active()
    session.take(HOME, np.ones(7))
    for _ in range(2000):
        drive = session.cycle(HOME, ZERO)
    assert np.array_equal(drive.torque, np.ones(7)), "the stack has no time-out: that is why there is a watchdog"


@pytest.mark.parametrize(
    ("break_it", "words"),
    [
        (lambda s: s.take(HOME + 60.0, ZERO), "command guard"),
        (lambda s: s.take(HOME, np.full(7, 300.0)), "controller"),
        (lambda s: [s.cycle(q, ZERO) for q in (HOME, HOME + 0.01)], "command guard"),
    ],
    ids=["far", "strong", "fast"],
)
def test_what_breaks_a_rule_ends_the_session_for_good(break_it: object, words: str) -> None:
    session = active()
    break_it(session)  # type: ignore[operator]
    session.cycle(HOME, ZERO)
    assert words in session.ended
    for _ in range(500):
        session.cycle(HOME, ZERO)
    assert session.state is SessionState.IDLE


def test_the_position_follows_as_the_stacks_controller_makes_it() -> None:
    session = active()
    session.take(HOME + 0.1, ZERO)
    assert session.cycle(HOME, ZERO).position == pytest.approx(HOME + 0.01)
    assert session.cycle(HOME, ZERO).position == pytest.approx(HOME + 0.02)
