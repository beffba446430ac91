"""The control service: joint states and set-points in, joint torques out, at 1 kHz."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np

from palpate_bus.contract import MS, contract
from palpate_bus.messages import ImpedanceSetpoint, JointTorqueCommand, Point, Pose, Quaternion, Twist, Vector3, Wrench, codec
from palpate_bus.messages.codec import Message
from palpate_bus.messages.stamps import NS, duration_message, header, nanoseconds
from palpate_bus.service import Inbox, Outbox, Service
from palpate_bus.setpoint import TOPIC, ControlMode, Setpoint
from palpate_control.impedance import ImpedanceController
from palpate_control.model import DOF, ArmModel
from palpate_control.reference import Extrapolator
from palpate_models.numerics.frames import Array
from palpate_models.robot.lbr import HOME, JOINT_NAMES, urdf
from palpate_models.scenario.load import exam_input
from palpate_models.scenario.schema import Limits, Robot, Scenario

_NAMES = list(JOINT_NAMES)


class ControlService(Service):
    """Follows set-points by impedance control.

    Before the first set-point it commands zero torque, so the driver keeps the arm gravity-compensated. Once a
    set-point has expired, or joint states are not finite, it sends commands that have expired already, and says why: the
    driver then holds safely by itself, which is better than anything that could be commanded blindly. While joint states
    are stale the last torque stands, no longer than it was valid anyway: late states are then what a late command is.

    A set-point counts in the time of the arm: one that is later than the newest measurement waits for it.
    """

    role: ClassVar[str] = "control"

    def __init__(self, robot: Robot, limits: Limits) -> None:
        self.model = ArmModel(urdf(robot))
        topics = contract().topics
        self._controller = ImpedanceController(self.model, limits.joint_margin_rad, contract().roles[self.role].period / NS)
        self._reference = Extrapolator(topics[TOPIC].period)
        self._setpoint_expiry = topics[TOPIC].expiry
        self._joint_states_age = topics["joint_states"].max_age
        self._validity = topics["control/joint_torque"].expiry
        self._valid = duration_message(self._validity)
        self._expired = duration_message(0)
        self._expires: int | None = None
        self._coming: deque[Setpoint] = deque()
        self._facts = dict.fromkeys(
            ("setpoints", "setpoints_rejected", "joint_states_rejected", "ticks_without_joint_states", "ticks_without_command"), 0
        )
        self._peak = np.zeros(DOF)
        self._torque = np.zeros(DOF)
        self._until = -1
        """The last torque and how long it is valid [ns]."""
        self._problem = ""
        self._refused = ""
        """What was wrong with the newest set-point; empty when it was good."""
        self._ceased = ""
        """Why the arm was left to the driver; empty since a good set-point has come."""
        self._warm_up()

    def _warm_up(self) -> None:
        """Compiles the law in both modes now, on set-points as they come from the bus: at 1 kHz there is no time for it."""
        kind, rest, still = "palpation_msgs/msg/ImpedanceSetpoint", np.zeros(DOF), Vector3(0.0, 0.0, 0.0)
        pose = Pose(Point(0.0, 0.0, 0.0), Quaternion(0.0, 0.0, 0.0, 1.0))
        for mode in ControlMode:
            guide = Extrapolator(contract().topics[TOPIC].period)
            for stamp in (0, MS):
                message = ImpedanceSetpoint(
                    header(stamp, "world"),
                    int(mode),
                    pose,
                    Twist(still, still),
                    Wrench(still, still),
                    np.ones(6),
                    np.ones(6),
                    rest,
                    rest,
                    np.ones(DOF),
                    self._valid,
                )
                guide.accept(Setpoint.from_message(codec.decode(codec.encode(message, kind), kind)), stamp)
                self._controller.torque(np.array(HOME), rest, guide.at(stamp))
        self._controller.reset()

    def step(self, t: int, inbox: Inbox) -> Outbox:
        """One control tick."""
        joints = inbox.latest("joint_states")
        received = inbox.stamp("joint_states")
        if received is None:
            received = t
        measured = t if joints is None else min(nanoseconds(joints.header.stamp), received, t)
        # The law compares the reference with a measurement, so it takes that of the same moment. With the present one a late
        # state would look like an error that grows with the speed, and wind the spring up: 17 mrad after 20 ms at 0.86 rad/s.
        followed = max(measured, t - self._setpoint_expiry)
        for message in inbox.new("planning/setpoint"):
            self._take(message, t)
        while self._coming and self._coming[0].stamp <= followed:
            self._reference.accept(self._coming.popleft(), followed)
        if self._expires is None or joints is None:
            return self._command(t, np.zeros(DOF), self._valid)
        frozen = t - measured > self._setpoint_expiry  # received again and again, or with a clock that is wrong
        if self._ceased or frozen or t > self._expires:
            old = f"joint_states were measured {(t - measured) / MS:.0f} ms ago, limit {self._setpoint_expiry / MS:.0f} ms"
            expired = f"the last {TOPIC} expired {(t - self._expires) / MS:.0f} ms ago"
            return self._cease(t, self._ceased or (old if frozen else self._refused or expired))
        if t - received > self._joint_states_age:
            age, limit = (t - received) / MS, self._joint_states_age / MS
            return self._stand(t, f"joint_states are {age:.0f} ms old, limit {limit:.0f} ms")
        if joints.name != _NAMES:
            return self._reject_joints(t, f"joint_states: name = {joints.name}: must be {_NAMES}")
        try:
            reference = self._reference.at(followed)
            torque = self._controller.torque(joints.position, joints.velocity, reference)
        except ValueError as error:
            return self._reject_joints(t, str(error))
        np.maximum(self._peak, np.abs(torque), out=self._peak)
        self._torque, self._until = torque, t + self._validity
        return self._command(t, torque, self._valid)

    def finish(self) -> Mapping[str, Any]:
        """Counts of set-points and rejections, the last problem, and the largest torque of each joint [N m]."""
        return {**self._facts, "problem": self._problem, "peak_torque_nm": [round(float(x), 3) for x in self._peak]}

    def _take(self, message: Message, t: int) -> None:
        """Checks a set-point; it is followed once the arm was measured at its time, the very first one at once."""
        try:
            setpoint = Setpoint.from_message(message)
        except ValueError as error:
            self._refuse(t, str(error).removeprefix(f"{TOPIC}: "))
            return
        if setpoint.stamp > t + self._setpoint_expiry:  # it would expire before it is due, and keep all later ones waiting
            limit = self._setpoint_expiry / MS
            self._refuse(t, f"stamped {(setpoint.stamp - t) / MS:.0f} ms ahead, limit {limit:.0f} ms")
            return
        while self._coming and self._coming[-1].stamp >= setpoint.stamp:
            self._coming.pop()  # planning's clock was set back: its newest word counts
        self._refused = self._ceased = ""
        self._facts["setpoints"] += 1
        if self._reference.current is None and not self._coming:
            self._reference.accept(setpoint, t)
        else:
            self._coming.append(setpoint)
        self._expires = min(setpoint.stamp, t) + min(nanoseconds(message.valid_for), self._setpoint_expiry)

    def _refuse(self, t: int, why: str) -> None:
        self._facts["setpoints_rejected"] += 1
        self._refused = f"{TOPIC} refused: {why}"
        self._problem = f"at {t} ns: {self._refused}"

    def _stand(self, t: int, problem: str) -> Outbox:
        """The last torque for as long as it is valid, then as `_cease`."""
        if t >= self._until:
            return self._cease(t, problem)
        self._facts["ticks_without_joint_states"] += 1
        self._problem = f"at {t} ns: {problem}"
        return self._command(t, self._torque, duration_message(self._until - t), problem)

    def _cease(self, t: int, problem: str) -> Outbox:
        """Leaves the arm to the driver's safe hold, and tells it why."""
        self._until = -1
        self._ceased = problem
        self._facts["ticks_without_command"] += 1
        self._problem = f"at {t} ns: {problem}"
        self._controller.reset()
        self._reference.clear()
        self._coming.clear()
        return self._command(t, np.zeros(DOF), self._expired, problem)

    def _reject_joints(self, t: int, problem: str) -> Outbox:
        self._facts["joint_states_rejected"] += 1
        return self._cease(t, problem)

    @staticmethod
    def _command(t: int, torque: Array, valid_for: Message, problem: str = "") -> Outbox:
        return {"control/joint_torque": JointTorqueCommand(header(t), torque, valid_for, problem)}


def create(scenario: Scenario) -> ControlService:
    """The service for a scenario, of which it may know the exam input."""
    known = exam_input(scenario)
    return ControlService(known.robot, known.limits)
