"""How soon the supervisor stops what planning should never have done: measured on the real services, in simulated time.

Run as a program it prints the table of services/supervisor/README.md.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from palpate_bus.composed import Composed
from palpate_bus.messages import ExamState, OperatorRequest, RobotStatus, SupervisorState
from palpate_bus.service import Inbox, Outbox, Service
from palpate_bus.stamps import NS, header, nanoseconds
from palpate_conductor.collector import Collector
from palpate_conductor.run import load_services
from palpate_models.load import load_scenario

MS = 1_000_000
SHORT = ("exam.region_m=[0.03,0.03]", "exam.centre_m=[-0.055,-0.055]", "camera.frames=2")
OTHERS = ("robot", "tissue", "control", "supervisor", "assessment", "camera", "perception")
MAD_AFTER = 300 * MS


class MadPlanning(Service):
    """Planning, until it goes mad in contact: it then moves its set-point by itself and heeds nobody."""

    role = "planning"

    def __init__(self, planning: Service, velocity: Callable[[np.ndarray], np.ndarray]) -> None:
        """`velocity(n)`: of the set-point [m/s], given the outward normal n."""
        self.planning, self.velocity = planning, velocity
        self.scan: int | None = None
        self.mad_at: int | None = None
        self.last: Any = None

    def step(self, t: int, inbox: Inbox) -> Outbox:
        if self.mad_at is None:
            out = dict(self.planning.step(t, inbox))
            self.last = out
            if self.scan is None and out["exam/state"].phase == ExamState.PHASE_SCAN:
                self.scan = t
            if self.scan is not None and t - self.scan >= MAD_AFTER:
                self.mad_at = t
            return out
        state, setpoint = self.last["exam/state"], self.last["planning/setpoint"]
        n = np.array((state.surface_normal.x, state.surface_normal.y, state.surface_normal.z))
        v = self.velocity(n)
        p, dt = setpoint.pose.position, (t - self.mad_at) / NS
        moved = type(p)(p.x + v[0] * dt, p.y + v[1] * dt, p.z + v[2] * dt)
        linear = type(setpoint.twist.linear)(*v.tolist())
        setpoint = dataclasses.replace(
            setpoint,
            header=header(t, "world"),
            pose=dataclasses.replace(setpoint.pose, position=moved),
            twist=dataclasses.replace(setpoint.twist, linear=linear),
        )
        return {"planning/setpoint": setpoint, "exam/state": dataclasses.replace(state, header=header(t, "world"))}


class Watcher(Collector):
    """The conductor's collector, with every state of supervisor and driver; it may send an operator's stop."""

    def __init__(self) -> None:
        super().__init__()
        self.states: list[Any] = []
        self.statuses: list[Any] = []
        self.stop_at: int | None = None

    def step(self, t: int, inbox: Inbox) -> Outbox:
        self.states.extend(inbox.new("supervisor/state"))
        self.statuses.extend(inbox.new("robot/status"))
        out = dict(super().step(t, inbox))
        if self.stop_at is not None and t >= self.stop_at:
            self.stop_at = None
            out["operator/request"] = OperatorRequest(header(t), OperatorRequest.STOP, "enough")
        return out


@dataclass
class Reaction:
    """What was measured; times in ms of simulated time, forces true."""

    cause: int
    reason: str
    to_stop: float
    """From the first true breach (or the event) to the supervisor's first stop."""
    to_hold: float
    """To the driver's hold."""
    force_at_stop: float
    peak_force: float
    speed_after: float
    """Of the set-point's doing: the tool half a second later [m/s]."""


CASES: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "pushes": lambda n: -0.10 * n,
    "rams": lambda n: -0.30 * n,
    "races": lambda n: np.array([0.0, 0.9, 0.0]),
    "operator": lambda n: np.zeros(3),
    "control lost": lambda n: np.zeros(3),
}


def react(name: str) -> Reaction:
    scenario = load_scenario("rlq_guarding", SHORT)
    (real,) = load_services(scenario, ("planning",))
    mad = MadPlanning(real, CASES[name])
    watcher = Watcher()
    run = Composed([mad, *load_services(scenario, OTHERS), watcher])
    struck: list[int] = []

    def end() -> int | None:
        if mad.mad_at is None:
            return 20 * NS if run.t > 20 * NS else None
        if not struck:
            struck.append(run.t)
            if name == "operator":
                watcher.stop_at = run.t
            elif name == "control lost":
                run.steppers["supervisor"].inbox.lost_roles.add("control")
        return mad.mad_at + 1500 * MS

    run.run(end, 30 * NS)
    assert mad.mad_at is not None, "it never came into contact"
    stop = next(s for s in watcher.states if s.level != SupervisorState.LEVEL_OK)
    hold = next(s for s in watcher.statuses if s.mode == RobotStatus.MODE_SAFE_HOLD)
    begin = mad.mad_at
    force = {nanoseconds(m.header.stamp): m.normal_force for m in watcher.collected.indentation}
    if name in ("pushes", "rams"):
        begin = next((t for t, f in force.items() if t >= begin and f > 15.0), begin)
    after = [f for t, f in force.items() if t >= mad.mad_at]
    return Reaction(
        int(stop.cause),
        stop.reason,
        (nanoseconds(stop.header.stamp) - begin) / MS,
        (nanoseconds(hold.header.stamp) - begin) / MS,
        force.get(nanoseconds(stop.header.stamp), 0.0),
        max(after),
        float(watcher.states[-1].speed),
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "cause"),
    [
        ("pushes", SupervisorState.CAUSE_FORCE),
        ("races", SupervisorState.CAUSE_SPEED),
        ("operator", SupervisorState.CAUSE_OPERATOR),
        ("control lost", SupervisorState.CAUSE_LOST),
    ],
)
def test_whatever_planning_does_the_arm_is_stopped(name: str, cause: int) -> None:
    reaction = react(name)
    assert reaction.cause == cause, reaction.reason
    assert reaction.peak_force < 25.0, reaction
    assert reaction.to_hold < 300.0
    assert reaction.speed_after < 0.02


if __name__ == "__main__":
    import sys

    print("| planning | first stop | to the stop | to the hold | force then, highest |")
    print("|---|---|---|---|---|")
    for case in sys.argv[1:] or CASES:
        r = react(case)
        row = f"{r.to_stop:.0f} ms | {r.to_hold:.0f} ms | {r.force_at_stop:.1f}, {r.peak_force:.1f} N"
        print(f"| {case} | {r.reason} | {row} |", flush=True)
