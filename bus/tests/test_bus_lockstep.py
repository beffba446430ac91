"""The runtimes: what a reader may see and when, failures, latencies, priorities, and the loss of the conductor."""

import os
import random
import subprocess
import sys
from collections import Counter, deque
from dataclasses import dataclass, field
from time import time_ns
from typing import Any
from unittest import mock

import numpy as np
import pytest
from hypothesis import given, strategies as st
from toy_services import TOYS, joint_state

from palpate_bus.contract import Edge, contract
from palpate_bus.messages import MS, NS, RunControl, codec
from palpate_bus.run import in_background
from palpate_bus.runtime import conductor_link
from palpate_bus.runtime.composed import Composed, ServiceFailed
from palpate_bus.runtime.conductor_link import CONTROL_TYPE, HEARTBEAT, TIMES, ConductorLink, RunAborted
from palpate_bus.runtime.failure import Failure, FailureCode
from palpate_bus.runtime.lockstep import ForgedSenderError, InputBuffer, LockstepError, Packet, Stepper
from palpate_bus.runtime.process import pid_space
from palpate_bus.runtime.wallclock import BIN_NS, WallClockNode, age_ms
from palpate_bus.wire.transport import ReceivedSample

TOPICS = contract().topics


def buffer(topic: str, edge: Edge) -> InputBuffer:
    row = TOPICS[topic]
    return InputBuffer(row, edge, contract().roles[row.producer].period)


def first_ready(tested: InputBuffer, t: int) -> int:
    """Return the earliest tick [ns] of the producer at which the reader may step at `t`."""
    for tick in (-1, *range(0, t + MS, MS)):
        tested.advanced = tick
        if tested.ready(t):
            return tick
    raise AssertionError(f"never ready for {t} ns")


def test_same_tick_needs_the_producers_tick_and_previous_the_one_before() -> None:
    assert first_ready(buffer("joint_states", Edge.SAME_TICK), 7 * MS) == 7 * MS
    assert first_ready(buffer("control/joint_torque", Edge.PREVIOUS), 7 * MS) == 6 * MS
    assert first_ready(buffer("control/joint_torque", Edge.PREVIOUS), 0) < 0


def test_a_slow_producer_has_its_whole_period_to_compute() -> None:
    setpoint = buffer("planning/setpoint", Edge.PREVIOUS)
    assert [first_ready(setpoint, t * MS) // MS for t in (10, 15, 19, 20, 29)] == [0, 0, 0, 10, 10]


def test_messages_become_visible_after_their_delay() -> None:
    torque = buffer("control/joint_torque", Edge.PREVIOUS)
    for sequence in range(1, 5):
        torque.accept(sequence, b"")
    torque.take(2 * MS)
    assert [received.stamp for received in torque.new] == [0, MS]
    torque.take(3 * MS)
    assert [received.stamp for received in torque.new] == [2 * MS]


@pytest.mark.parametrize(
    ("sequences", "text"),
    [([2], "messages 1..1 of robot are missing"), ([5], "messages 1..4 of robot are missing"), ([1, 1], "duplicate")],
)
def test_a_gap_or_a_repetition_is_an_error_that_names_the_topic(sequences: list[int], text: str) -> None:
    joints = buffer("joint_states", Edge.SAME_TICK)
    with pytest.raises(LockstepError, match=f"joint_states: .*{text}"):
        for sequence in sequences:
            joints.accept(sequence, b"")


@given(counts=st.lists(st.integers(0, 3), min_size=1, max_size=12), order=st.randoms(use_true_random=False))
def test_event_topics_read_the_same_whatever_order_data_and_advances_arrive_in(counts: list[int], order: random.Random) -> None:
    period = 100 * MS
    sent = [(tick * period, sequence) for tick, count in enumerate(counts) for sequence in range(count)]
    stamps = [stamp for stamp, _ in sent]
    data = [("data", sequence + 1) for sequence in range(len(sent))]
    advances = [("advance", tick * period, sum(counts[: tick + 1])) for tick in range(len(counts))]
    merged: list[tuple[object, ...]] = []
    while data or advances:  # each stream is in order; how they interleave is not known
        merged.append((data if data and (not advances or order.random() < 0.5) else advances).pop(0))
    images = buffer("camera/depth/image_raw", Edge.PREVIOUS)
    for event in merged:
        if event[0] == "data":
            images.accept(int(str(event[1])), b"")
        else:
            images.advance(int(str(event[1])), int(str(event[2])))
    assert images.advanced == (len(counts) - 1) * period
    images.take(len(counts) * period)
    assert [received.stamp for received in images.new] == stamps


def test_event_topic_is_not_ready_before_its_messages_are_here() -> None:
    images = buffer("camera/depth/image_raw", Edge.PREVIOUS)
    images.advance(0, 1)
    assert not images.ready(100 * MS)
    assert images.waits_for_data
    images.accept(1, b"")
    assert images.ready(100 * MS)


def test_a_lost_producer_blocks_no_reader() -> None:
    joints = buffer("joint_states", Edge.SAME_TICK)
    joints.lost = True
    assert joints.ready(5 * MS)


@pytest.mark.parametrize(
    ("role", "change", "said"),
    [
        ("robot", lambda t, out: {k: v for k, v in out.items() if k != "ft/wrench"}, "robot sent no ft/wrench at 0 ns"),
        ("camera", lambda t, out: {"ft/wrench": None}, "camera sent ft/wrench"),
        ("robot", lambda t, out: {**out, "robot/status": None} if t else out, "not a multiple of its period"),
    ],
)
def test_an_outbox_that_breaks_the_contract_is_named(role: str, change: Any, said: str) -> None:
    toy = TOYS[role]()
    step = toy.step
    toy.step = lambda t, inbox: change(t, dict(step(t, inbox)))  # type: ignore[method-assign]
    stepper = Stepper(toy, contract())
    with pytest.raises(LockstepError, match=said):
        [stepper.step(t) for t in (0, MS)]


@pytest.mark.parametrize("returned", [None, [None], "ft/wrench", 3, iter(())])
def test_what_is_no_outbox_is_named(returned: object) -> None:
    for method, call in (("step", lambda stepper: stepper.step(0)), ("start", lambda stepper: stepper.start())):
        toy = TOYS["robot"]()
        setattr(toy, method, lambda *_: returned)
        with pytest.raises(LockstepError, match=f"robot returned {type(returned).__name__}; expected an outbox"):
            call(Stepper(toy, contract()))


def test_latched_topics_are_due_at_start() -> None:
    toy = TOYS["robot"]()
    toy.start = dict  # type: ignore[method-assign, assignment]
    with pytest.raises(LockstepError, match="did not send its latched robot_description"):
        Stepper(toy, contract()).start()


ROW, ROBOT_STATUS = contract().topics["joint_states"], contract().topics["robot/status"]


def latencies(payload: bytes) -> InputBuffer:
    held = InputBuffer(ROW, Edge.SAME_TICK, contract().roles["robot"].period)
    held.deliver(Packet(payload, 0, 1))
    held.take(0)
    return held


def joints(position: np.ndarray) -> bytes:
    return codec.encode(joint_state(0, position), ROW.type)


def test_valid_inputs_are_not_named() -> None:
    failure = Failure.of(ValueError("no"), "control", [latencies(joints(np.zeros(7)))])
    assert failure == Failure(FailureCode.ROLE_FAILED, "ValueError: no", ("control",))
    assert Failure.from_report("control", failure.report()) == failure


@pytest.mark.parametrize(
    ("payload", "text"),
    [(joints(np.full(7, np.nan)), "ValueError: no; joint_states from robot has position nan"), (b"\x00\x01\x00\x00\xff", "")],
)
def test_an_input_that_is_not_finite_or_cannot_be_decoded_is_named(payload: bytes, text: str) -> None:
    failure = Failure.of(ValueError("no"), "control", [latencies(payload)])
    assert failure.topics == ("joint_states",)
    assert failure.text.startswith(text)


def test_some_errors_have_a_code_of_their_own() -> None:
    forged, full = ForgedSenderError("twice", "joint_states"), OSError(28, "No space left on device")
    assert Failure.of(forged, "control", ()).code is FailureCode.FORGED
    assert Failure.of(full, "control", ()).code is FailureCode.DISK_FULL


def test_services_that_fail_at_their_end_do_not_hide_the_first_failure() -> None:
    services = [toy() for toy in TOYS.values()]
    failing = mock.Mock(side_effect=ArithmeticError("the cause"))
    for service in services:
        if service.role == "control":
            service.step, service.finish = failing, mock.Mock(side_effect=KeyError("a consequence"))  # type: ignore[method-assign]
        if service.role == "tissue":
            service.finish = mock.Mock(side_effect=SystemExit(1))  # type: ignore[method-assign]
    run = Composed(services)
    with pytest.raises(ServiceFailed):
        run.run(lambda: None, MS)
    assert run.finish().keys() == TOYS.keys() - {"control", "tissue"}
    assert run.lost == {"control": 0, "tissue": 0}
    assert run.failure == Failure(FailureCode.ROLE_FAILED, "control lost at 0.000 s: ArithmeticError: the cause", ("control",))


def test_a_replacement_starts_once_it_has_named_its_process() -> None:
    node = WallClockNode.__new__(WallClockNode)
    node._link, node._seat, node._data, node._now = mock.Mock(), mock.Mock(role="camera"), {}, time_ns
    node._receive = mock.Mock()  # type: ignore[method-assign]
    said = [("assessment", RunControl.HELLO), ("", RunControl.GRANT), ("camera", RunControl.HELLO), ("", RunControl.GRANT)]
    node._link.poll.side_effect = [RunControl(command, 0, False, role, "") for role, command in said]
    node._await_start()
    assert node._link.poll.call_count == 4
    (report,) = node._seat.reports.send.call_args_list
    assert report.kwargs["detail"]["pid"] == os.getpid()


def test_a_late_driver_of_hardware_sends_its_status_in_time() -> None:
    """It skips to the present tick, which is rarely a multiple of the status's period: there were gaps of 170 ms."""
    node = WallClockNode.__new__(WallClockNode)
    node._stepper = Stepper(TOYS["robot"](), contract(), strict=False)
    node._seat, node._link, node._number, node._end, node._rate = mock.Mock(), mock.Mock(), Counter(), NS, 1.0
    node._seat.service.catches_up, node._link.poll.return_value = False, None
    node._receive = node._note_lost_conductor = mock.Mock()  # type: ignore[method-assign]
    node._await_inputs, clock, stepped = lambda: 0, [0], []  # type: ignore[method-assign]
    node._run_time = lambda: clock[0]  # type: ignore[method-assign]

    def step(_: Any, t: int) -> None:
        stepped.append(t)
        clock[0] += (21 + len(stepped) % 17) * MS // 10

    node._step_and_send = step  # type: ignore[assignment]
    node._loop()
    sent = np.array([t for t in stepped if t % ROBOT_STATUS.period == 0])
    assert np.diff(sent).max() <= 2 * ROBOT_STATUS.period
    assert np.diff(stepped).min() > 0


def test_ages_are_those_of_the_messages_to_within_a_bin() -> None:
    values = (np.random.default_rng(1).lognormal(0.0, 0.7, 5000) * 1e6).astype(int)
    figures = age_ms(Counter((values // BIN_NS).tolist()))
    wanted = {"mean": values.mean(), "p50": np.quantile(values, 0.5), "p99": np.quantile(values, 0.99), "max": values.max()}
    assert figures == {name: pytest.approx(value / 1e6, abs=BIN_NS / 1e6) for name, value in wanted.items()}


PROGRAM = """
import os, sys, threading, time
from palpate_bus.runtime.process import BACKGROUND_NICENESS, run_in_background
run_in_background()  # elsewhere than on Linux it lowers the priority at most
after = threading.Thread(target=time.sleep, args=(30,), daemon=True)
after.start()
for thread in (0, after.native_id) if sys.platform == "linux" else ():
    assert os.sched_getscheduler(thread) == os.SCHED_BATCH
    assert os.getpriority(os.PRIO_PROCESS, thread) == min(int(os.environ["HERE"]) + BACKGROUND_NICENESS, 19)
"""


def test_a_background_service_and_its_threads_have_low_priority() -> None:
    here = os.getpriority(os.PRIO_PROCESS, 0)
    subprocess.run([sys.executable, "-c", PROGRAM], check=True, env={**os.environ, "HERE": str(here)})


def test_in_lockstep_all_but_the_1_kHz_loop_run_in_the_background() -> None:
    roles = contract().roles
    assert {name for name, role in roles.items() if not in_background(role, "lockstep")} == {"robot", "tissue", "control"}
    observers = {name for name, role in roles.items() if role.observer}
    assert {name for name, role in roles.items() if in_background(role, "wallclock")} == observers


STEP_S = 0.01
PID = 4711
DEADLINE_S = contract().internal[HEARTBEAT].deadline / 1e9


@dataclass
class Queue:
    waiting: deque[tuple[int, bytes]] = field(default_factory=deque)
    garbage: int = 0
    latest: tuple[int, bytes] = (0, b"")
    """The last message with its number; a replayed one repeats it."""

    def get(self, timeout: float | None) -> ReceivedSample | None:
        number, payload = self.waiting.popleft() if self.waiting else (0, b"")
        return ReceivedSample(number, 0, payload) if payload else None

    def put(self, payload: bytes) -> None:
        self.latest = (self.latest[0] + 1, payload)
        self.waiting.append(self.latest)

    def replay(self) -> None:
        self.waiting.append(self.latest)


class Bus:
    """Member of a bus with a conductor only, and the time."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, runtime: str) -> None:
        monkeypatch.setenv("PALPATE_RUNTIME", runtime)
        monkeypatch.setattr(conductor_link, "monotonic", lambda: self.now)
        monkeypatch.setattr(conductor_link, "is_running", lambda pid: self.runs and pid == PID)
        self.contract = contract()
        self.now = 100.0
        self.runs = False
        self.token = True
        self.queues = {"palpate/control": Queue(), HEARTBEAT: Queue()}

    def internal_subscription(self, name: str, type_name: str) -> Queue:
        assert type_name == CONTROL_TYPE
        return self.queues[name]

    def gone(self) -> frozenset[str]:
        return frozenset() if self.token else frozenset({"conductor"})

    def transport_lost(self) -> bool:
        return False

    def say(self, command: int) -> None:
        name = HEARTBEAT if command == RunControl.HEARTBEAT else "palpate/control"
        message = RunControl(command, PID, False, "", pid_space())
        self.queues[name].put(codec.encode(message, CONTROL_TYPE))

    def link(self, grace_s: float = 0.0) -> ConductorLink:
        """Return a link that has received the start and a heartbeat."""
        member: Any = self
        link = ConductorLink(member, grace_s)
        self.say(RunControl.GRANT)
        assert link.poll() is not None
        self.say(RunControl.HEARTBEAT)
        link.poll()
        return link

    def silence(self, link: ConductorLink, seconds: float, step_s: float = STEP_S) -> float:
        """Advance the clock by `seconds`; return the time at which the conductor was lost, infinity if it was not."""
        begin = self.now
        while self.now - begin < seconds:
            self.now += step_s
            link.poll()
            if link.lost:
                return self.now - begin
        return float("inf")


@pytest.fixture
def wallclock(monkeypatch: pytest.MonkeyPatch) -> Bus:
    return Bus(monkeypatch, "wallclock")


@pytest.mark.parametrize(
    ("runtime", "runs", "limit_s"),
    [
        ("wallclock", False, DEADLINE_S),
        ("wallclock", True, TIMES.busy_s),
        ("lockstep", False, TIMES.lockstep_heartbeat_s),
        ("lockstep", True, TIMES.lockstep_busy_s),
    ],
)
def test_silence_is_noticed_later_in_lockstep_and_while_the_process_runs_without_a_core(
    runtime: str, runs: bool, limit_s: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    bus = Bus(monkeypatch, runtime)
    bus.runs = runs
    assert limit_s < bus.silence(bus.link(grace_s=9.0), 60.0) <= limit_s + 0.1


def test_a_service_that_was_itself_kept_from_a_core_does_not_blame_the_conductor(wallclock: Bus) -> None:
    link = wallclock.link(grace_s=9.0)
    assert wallclock.silence(link, 0.9, step_s=0.45) == float("inf")


def test_a_conductor_whose_token_is_gone_is_lost_at_once(wallclock: Bus) -> None:
    link = wallclock.link(grace_s=9.0)
    wallclock.token = False
    assert wallclock.silence(link, 1.0) <= 5 * STEP_S


def test_services_leave_after_the_grace_period(wallclock: Bus) -> None:
    link = wallclock.link(grace_s=2.0)
    assert wallclock.silence(link, 1.0) < 1.0
    lost_at = wallclock.now
    with pytest.raises(RunAborted, match="no heartbeat for"):
        for _ in range(1000):
            wallclock.now += STEP_S
            link.poll()
    assert 2.0 <= wallclock.now - lost_at < 2.1


def test_a_conductor_that_returns_is_not_lost(wallclock: Bus) -> None:
    link = wallclock.link(grace_s=2.0)
    wallclock.silence(link, 1.0)
    wallclock.say(RunControl.HEARTBEAT)
    link.poll()
    assert not link.lost


def test_a_conductor_without_a_heartbeat_has_the_limit_of_a_start(wallclock: Bus) -> None:
    member: Any = wallclock
    link = ConductorLink(member, 9.0)
    wallclock.say(RunControl.GRANT)
    link.poll()
    assert wallclock.silence(link, 9.0) == float("inf")


def test_a_replayed_heartbeat_is_ignored(wallclock: Bus) -> None:
    link = wallclock.link(grace_s=9.0)
    for _ in range(30):
        wallclock.queues[HEARTBEAT].replay()
        wallclock.silence(link, STEP_S)
    assert link.lost


def test_a_replayed_control_message_is_ignored(wallclock: Bus) -> None:
    link = wallclock.link()
    wallclock.queues["palpate/control"].replay()
    assert link.poll() is None
    assert link.garbage == 1
