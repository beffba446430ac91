"""The check at the ports: what breaks the contract is refused and named, where it is sent and where it is received."""

from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from message_strategies import messages as drawn
from toy_services import TOYS, Robot, torque_command

from palpate_bus import messages as msg
from palpate_bus.contract import contract
from palpate_bus.contract.port_check import Checker, PortCheck, RefusedMessage
from palpate_bus.messages import MS, NS, Vector3, Wrench, blank, codec, header, nanoseconds
from palpate_bus.runtime.composed import Composed, ServiceFailed
from palpate_bus.runtime.failure import FailureCode
from palpate_bus.runtime.lockstep import Packet, Stepper
from palpate_bus.service import Inbox, Outbox, Service

RULES = contract()
NAN, INF = float("nan"), float("inf")


@pytest.mark.filterwarnings("ignore:overflow")
@pytest.mark.parametrize("name", RULES.topics)
@settings(max_examples=15)
@given(data=st.data())
def test_it_accepts_what_the_checker_finds_nothing_in(name: str, data: st.DataObject) -> None:
    topic = RULES.topics[name]
    message = data.draw(drawn(topic.type))
    if topic.frame is not None and hasattr(message, "header"):
        message.header.frame_id = topic.frame
    found = Checker(topic)(message)
    with pytest.raises(RefusedMessage) if found else nullcontext() as refused:
        PortCheck(topic)(message, nanoseconds(message.header.stamp) if hasattr(message, "header") else 0)
    assert not found or refused.value.violation == found[0]


def joints(message: Any, field: str, value: float) -> Any:
    return replace(message, **{field: np.array([0.0, 0.0, 0.0, value, 0.0, 0.0, 0.0])})


def force(value: float) -> Callable[[Any], Any]:
    return lambda message: replace(message, wrench=Wrench(Vector3(0.0, value, 0.0), Vector3(0.0, 0.0, 0.0)))


LIES: dict[str, tuple[str, Callable[[Any], Any], tuple[str, ...]]] = {
    "force is NaN": ("ft/wrench", force(NAN), ("wrench.force = nan", "-200..200 [N]")),
    "force is infinite": ("ft/wrench", force(-INF), ("wrench.force = -inf", "-200..200 [N]")),
    "force is too large": ("ft/wrench", force(201.0), ("wrench.force = 201", "-200..200 [N]")),
    "one joint is NaN": ("joint_states", lambda m: joints(m, "velocity", NAN), ("velocity = nan", "-4..4 [rad/s]")),
    "one joint is infinite": ("joint_states", lambda m: joints(m, "effort", INF), ("effort = inf", "-400..400 [N m]")),
    "one joint is in degrees": ("joint_states", lambda m: joints(m, "position", 90.0), ("position = 90", "deg")),
    "another frame": ("ft/wrench", lambda m: replace(m, header=header(0, "moon")), ("'moon'", "ft_sensor")),
    "another type": ("ft/wrench", lambda _: Vector3(0.0, 0.0, 0.0), ("geometry_msgs/msg/WrenchStamped",)),
    "a field without a range": ("sim/tool_state", lambda m: _turned(m, NAN), ("pose.orientation.y = nan", "finite")),
    "a quaternion of another length": ("sim/tool_state", lambda m: _turned(m, 0.5), ("with norm 1.118", "a norm of 1")),
    "old stamp": ("joint_states", lambda m: replace(m, header=header(0)), ("header.stamp = 0 ms at 20 ms", "19 ms")),
    "stamp of later": ("joint_states", lambda m: replace(m, header=header(NS)), ("1000 ms at 20 ms", "500 ms ahead")),
    "spike": ("joint_states", lambda m: joints(m, "position", 0.1), ("position = 0.1 after", "a change of 4 rad per second")),
    "text for a number": ("ft/wrench", force("much"), ("ft/wrench",)),  # type: ignore[arg-type]
}


def _turned(message: Any, value: float) -> Any:
    orientation = replace(message.pose.orientation, y=value)
    return replace(message, pose=replace(message.pose, orientation=orientation))


class Liar(Robot):
    def __init__(self, lie: str, at: int = 20 * MS) -> None:
        self._topic, self._change, _ = LIES[lie]
        self._at = at

    def step(self, t: int, inbox: Inbox) -> Outbox:
        sent = dict(super().step(t, inbox))
        if t >= self._at:
            sent[self._topic] = self._change(sent[self._topic])
        return sent


@pytest.mark.parametrize("lie", LIES)
def test_in_lockstep_the_run_ends_with_the_first_message_that_breaks_the_contract(lie: str) -> None:
    others: list[Service] = [toy() for role, toy in TOYS.items() if role != "robot"]
    run = Composed([Liar(lie), *others])
    with pytest.raises(ServiceFailed) as caught:
        run.run(lambda: None, 100 * MS)
    topic, _, words = LIES[lie]
    assert caught.value.t == 20 * MS
    assert (caught.value.failure.code, caught.value.failure.topics) == (FailureCode.CONTRACT_BROKEN, (topic,))
    assert caught.value.failure.roles == ("robot",)
    assert all(word in str(caught.value) for word in (*words, f"{topic} from robot refused"))


BY_PAST = ("old stamp", "stamp of later", "spike")


@pytest.mark.parametrize("lie", [name for name in LIES if name not in ("another type", "text for a number", *BY_PAST)])
def test_a_reader_refuses_what_a_foreign_sender_puts_on_the_bus(lie: str) -> None:
    """The bytes of a sender that has no such check."""
    topic, change, words = LIES[lie]
    row = RULES.topics[topic]
    reader = next(iter(row.readers))

    class Reader(Service):
        role = reader

        def step(self, t: int, inbox: Inbox) -> Outbox:
            inbox.latest(topic)
            return {}

    good = Liar(lie, 10**18).step(0, Stepper(Robot(), RULES).inbox)[topic]
    for message, expected in ((good, nullcontext()), (change(good), pytest.raises(RefusedMessage))):
        stepper = Stepper(Reader(), RULES, strict=False)
        stepper.buffers[topic].accept(1, codec.encode(message, row.type))
        with expected as caught:
            stepper.step(0)
    assert all(word in str(caught.value) for word in words)


def test_by_the_wall_clock_it_is_not_sent_and_reported() -> None:
    refused: list[RefusedMessage] = []
    stepper = Stepper(Liar("force is NaN", MS), RULES, strict=False, refuse=refused.append)
    sent = [{port.topic.name for port, _ in stepper.step(t)} for t in (0, MS, 2 * MS)]
    assert ["ft/wrench" in names for names in sent] == [True, False, False]
    assert all("joint_states" in names for names in sent)
    assert [(one.role, one.topic) for one in refused] == [("robot", "ft/wrench")] * 2


def test_a_message_is_held_against_the_contract_once() -> None:
    """Readers in the sender's process do not check again: a packet of a port is checked."""
    stepper = Stepper(Liar("force is NaN", 10**18), RULES, strict=False)
    assert all(packet.checked for _, packet in stepper.step(0))
    assert not Packet(b"", 0, 1).checked


def status(t: int, force: float, stamp: int | None = None, cause: int = 0) -> Any:
    q = np.full(7, 1e-9 * t)
    fields = {"wrench": Wrench(Vector3(force, 0.0, 0.0), Vector3(1e-9 * t, 0.0, 0.0)), "position": q, "velocity": q}
    message = blank("palpation_msgs/msg/RobotStatus", t if stamp is None else stamp)
    return replace(message, mode=1, cause=cause, applied_torque=q, measured_torque=q, **fields)


def test_a_frozen_value_is_refused_until_it_changes() -> None:
    check = PortCheck(RULES.topics["robot/status"])
    for t in range(0, 70 * MS, 10 * MS):
        check(status(t, 5.0 if t else 4.0), t)
    with pytest.raises(RefusedMessage, match="7 messages in a row"):
        check(status(70 * MS, 5.0), 70 * MS)
    check(status(80 * MS, 5.1), 80 * MS)
    for t in range(90 * MS, 200 * MS, 10 * MS):  # a driver that names a cause may have no newer measurement
        check(status(t, 5.1, cause=9), t)
    check(status(200 * MS, 90.0), 200 * MS)


def test_joint_states_of_no_joints_are_not_compared() -> None:
    check, none = PortCheck(RULES.topics["joint_states"]), np.zeros(0)
    for t, q in ((0, np.full(7, 1.0)), *((k * MS, none) for k in range(1, 100)), (100 * MS, np.full(7, 1.5))):
        check(msg.JointState(header(t), [], q, q, q), t)
    with pytest.raises(RefusedMessage, match=r"position = 1\.6 after 1\.5"):
        check(msg.JointState(header(101 * MS), [], *(np.full(7, 1.6),) * 3), 101 * MS)


def refusal(text: str) -> Any:
    """Return a context in which a message is refused with this text, or in which none is if it is empty."""
    return pytest.raises(RefusedMessage, match=text) if text else nullcontext()


@pytest.mark.parametrize(("state", "text"), [(msg.SurfaceMotion.QUIET, "22 messages in a row"), (msg.SurfaceMotion.LOST, "")])
def test_a_breath_that_repeats_is_refused_while_it_is_followed(state: int, text: str) -> None:
    check = PortCheck(RULES.topics["perception/motion"])
    with refusal(text):
        for t in range(0, 3 * NS, 100 * MS):
            still = msg.SurfaceMotion(header(t, "abdomen"), state, 0.0, np.zeros(11), 0.001, Vector3(0.0, 0.0, 0.0))
            check(still, t)


def setpoint(t: int, orientation: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 1e-9), first: float = 0.3) -> Any:
    message, q = blank("palpation_msgs/msg/ImpedanceSetpoint", t, "world"), np.array((first, *(0.9,) * 6))
    pose = msg.Pose(msg.Point(0.0, 0.0, 1.0), msg.Quaternion(*orientation))
    return replace(message, mode=1, pose=pose, joint_position=q, joint_velocity=0 * q, joint_stiffness=q)


def torque(t: int, first: float = 3.0, problem: str = "") -> Any:
    return torque_command(t, np.array((first, *(1.0,) * 6)), problem)


@pytest.mark.parametrize(
    ("topic", "before", "after", "refused"),
    [
        ("planning/setpoint", setpoint, lambda t: setpoint(t, (-1.0, 0.0, 0.0, 1e-9)), ""),
        ("planning/setpoint", setpoint, lambda t: setpoint(t, (1e-9, 1.0, 0.0, 0.0)), "pose.orientation = 3.14159 rad from"),
        ("planning/setpoint", setpoint, lambda t: setpoint(t, first=0.9), "joint_position = 0.9 after 0.3"),
        ("control/joint_torque", torque, lambda t: torque(t, 4.0), ""),
        ("control/joint_torque", torque, lambda t: torque(t, -25.0), "torque = -25 after 3"),
        ("control/joint_torque", torque, lambda t: torque(t, -25.0, "the last set-point expired"), ""),
    ],
)
def test_a_leap_is_refused_where_messages_are_compared(topic: str, before: Any, after: Any, refused: str) -> None:
    check = PortCheck(RULES.topics[topic])
    check(before(10 * MS), 10 * MS)
    with refusal(refused):
        check(after(20 * MS), 20 * MS)


def test_a_refused_spike_leaves_the_messages_after_it_alone() -> None:
    check = PortCheck(RULES.topics["robot/status"])
    check(status(0, 5.0), 0)
    with pytest.raises(RefusedMessage, match=r"wrench\.force = 40 after 5, 10 ms apart"):
        check(status(10 * MS, 40.0), 10 * MS)
    check(status(20 * MS, 5.1), 20 * MS)


def test_a_repeated_stamp_is_refused_at_the_age_of_the_contract() -> None:
    check = PortCheck(RULES.topics["robot/status"])
    for t in (0, 50 * MS, 100 * MS):
        check(status(0, 0.0), t)
    with pytest.raises(RefusedMessage, match="100 ms old"):
        check(status(0, 0.0), 110 * MS)
