"""Parts of the runtimes: failures, latencies, priorities."""

import os
import subprocess
import sys
from collections import Counter
from time import time_ns
from typing import Any
from unittest import mock

import numpy as np
import pytest
from toy_services import TOYS, joint_state

from palpate_bus.contract import Edge, contract
from palpate_bus.messages import MS, NS, RunControl, codec
from palpate_bus.run import in_background
from palpate_bus.runtime.composed import Composed, ServiceFailed
from palpate_bus.runtime.failure import Failure, FailureCode
from palpate_bus.runtime.lockstep import ForgedSenderError, InputBuffer, Packet, Stepper
from palpate_bus.runtime.wallclock import BIN_NS, WallClockNode, age_ms

ROW, ROBOT_STATUS = contract().topics["joint_states"], contract().topics["robot/status"]


def buffer(payload: bytes) -> InputBuffer:
    held = InputBuffer(ROW, Edge.SAME_TICK, contract().roles["robot"].period)
    held.deliver(Packet(payload, 0, 1))
    held.take(0)
    return held


def joints(position: np.ndarray) -> bytes:
    return codec.encode(joint_state(0, position), ROW.type)


def test_valid_inputs_are_not_named() -> None:
    failure = Failure.of(ValueError("no"), "control", [buffer(joints(np.zeros(7)))])
    assert failure == Failure(FailureCode.ROLE_FAILED, "ValueError: no", ("control",))
    assert Failure.from_report("control", failure.report()) == failure


@pytest.mark.parametrize(
    ("payload", "text"),
    [(joints(np.full(7, np.nan)), "ValueError: no; joint_states from robot has position nan"), (b"\x00\x01\x00\x00\xff", "")],
)
def test_an_input_that_is_not_finite_or_cannot_be_decoded_is_named(payload: bytes, text: str) -> None:
    failure = Failure.of(ValueError("no"), "control", [buffer(payload)])
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
