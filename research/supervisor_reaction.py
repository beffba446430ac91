"""Reaction times of the supervisor to faults of planning and other services, measured on the real services in simulated time.

`python -m research.supervisor_reaction` prints the table of docs/faults.md.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from palpate.run.composed import load_services
from palpate_bus.messages import MS, NS, ExamState, OperatorRequest, RobotStatus, SupervisorState, header, nanoseconds
from palpate_bus.messages.geometry import point_message, vector, vector_message
from palpate_bus.runtime.composed import Composed
from palpate_bus.service import Inbox, Outbox, Service
from palpate_conductor.collector import Collector
from palpate_models.numerics.frames import Array
from palpate_models.scenario.load import load_scenario

SHORT = ("exam.region_m=[0.03,0.03]", "exam.centre_m=[-0.055,-0.055]", "camera.frames=2")
OTHERS = ("robot", "tissue", "control", "supervisor", "assessment", "camera", "perception")
FAULT_AFTER = 300 * MS


class FaultyPlanning(Service):
    """Planning that fails in contact: it then moves its set-point and ignores all messages."""

    role = "planning"

    def __init__(self, planning: Service, velocity: Callable[[Array], Array]) -> None:
        """`velocity(n)`: of the set-point [m/s], given the outward normal n."""
        self.planning, self.velocity = planning, velocity
        self.scan: int | None = None
        self.faulty_at: int | None = None
        self.last: dict[str, Any] = {}

    def step(self, t: int, inbox: Inbox) -> Outbox:
        """Plan, until the fault."""
        if self.faulty_at is None:
            self.last = dict(self.planning.step(t, inbox))
            if self.scan is None and self.last["exam/state"].phase == ExamState.PHASE_SCAN:
                self.scan = t
            if self.scan is not None and t - self.scan >= FAULT_AFTER:
                self.faulty_at = t
            return self.last
        state, setpoint = self.last["exam/state"], self.last["planning/setpoint"]
        v, now = self.velocity(vector(state.surface_normal)), header(t, "world")
        moved = vector(setpoint.pose.position) + v * (t - self.faulty_at) / NS
        pose, twist = replace(setpoint.pose, position=point_message(moved)), replace(setpoint.twist, linear=vector_message(v))
        setpoint = replace(setpoint, header=now, pose=pose, twist=twist)
        return {"planning/setpoint": setpoint, "exam/state": replace(state, header=now)}


class Watcher(Collector):
    """The conductor's collector, with every state of supervisor and driver; it may send an operator's request."""

    def __init__(self) -> None:
        super().__init__()
        self.states: list[Any] = []
        self.statuses: list[Any] = []
        self.request: int | None = None

    def step(self, t: int, inbox: Inbox) -> Outbox:
        """Collect, and send a request."""
        self.states.extend(inbox.new("supervisor/state"))
        self.statuses.extend(inbox.new("robot/status"))
        out = dict(super().step(t, inbox))
        if self.request is not None:
            out["operator/request"] = OperatorRequest(header(t), self.request, "enough")
            self.request = None
        return out


@dataclass
class Reaction:
    """Measured reaction: times in ms of simulated time, true forces."""

    causes: list[int]
    """Causes of the supervisor's stops, one after the other."""
    reason: str
    """Reason of the first stop."""
    to_stop: float
    """From the first true breach (or the event) to the supervisor's first stop."""
    to_hold: float
    """To the driver's hold."""
    force_at_stop: float
    peak_force: float
    speed_after: float
    """Speed of the tool 1.5 s later [m/s]."""


@dataclass(frozen=True)
class Case:
    """A fault in contact, and the event from which the reaction is timed."""

    cause: int
    """Cause of the first stop."""
    velocity: Callable[[Array], Array] = lambda n: np.zeros(3)
    """Velocity of the set-point [m/s], given the outward normal n."""
    settings: tuple[str, ...] = ()
    request: int | None = None
    """Request of an operator."""
    breach: Callable[[Any], bool] | None = None
    """True if a `truth/indentation` exceeds the limit; None: timed from the event."""


CASES: dict[str, Case] = {
    "pushes at 100 mm/s": Case(SupervisorState.CAUSE_FORCE, lambda n: -0.10 * n, breach=lambda m: m.normal_force > 15.0),
    "rams at 300 mm/s": Case(SupervisorState.CAUSE_FORCE, lambda n: -0.30 * n, breach=lambda m: m.normal_force > 15.0),
    "sinks at 20 mm/s": Case(
        SupervisorState.CAUSE_DEPTH,
        lambda n: -0.02 * n,
        ("exam.depth_m=0.008", "limits.depth_m=0.008"),
        breach=lambda m: m.depth > 0.013,
    ),
    "races aside at 900 mm/s": Case(SupervisorState.CAUSE_SPEED, lambda n: np.array([0.0, 0.9, 0.0])),
    "strays aside at 200 mm/s": Case(
        SupervisorState.CAUSE_WORKSPACE, lambda n: 0.1 * n + np.array([0.0, 0.2, 0.0]), ("limits.workspace_max_m=[0.7,0.1,1.2]",)
    ),
    "operator stops": Case(SupervisorState.CAUSE_OPERATOR, request=OperatorRequest.STOP),
    "control is gone": Case(SupervisorState.CAUSE_LOST),
    "an unknown request": Case(SupervisorState.CAUSE_INVALID, request=99),
}


def react(name: str) -> Reaction:
    """Return the reaction to a case of CASES."""
    case = CASES[name]
    scenario = load_scenario("clean", (*SHORT, *case.settings))
    (real,) = load_services(scenario, ("planning",))
    faulty = FaultyPlanning(real, case.velocity)
    watcher = Watcher()
    others = load_services(scenario, OTHERS)
    run = Composed([faulty, *others, watcher])
    struck: list[int] = []

    def end() -> int | None:
        if faulty.faulty_at is None:
            return 20 * NS if run.t > 20 * NS else None
        if not struck:
            struck.append(run.t)
            watcher.request = case.request
            if case.cause == SupervisorState.CAUSE_LOST:
                run.steppers["supervisor"].inbox.lost_roles.add("control")
        return faulty.faulty_at + 1500 * MS

    run.run(end, 30 * NS)
    assert faulty.faulty_at is not None, "it never came into contact"
    stops = [s for s in watcher.states if s.level != SupervisorState.LEVEL_OK]
    hold = next(s for s in watcher.statuses if s.mode == RobotStatus.MODE_SAFE_HOLD)
    begin = faulty.faulty_at
    truth = {nanoseconds(m.header.stamp): m for m in watcher.collected.indentation}
    force = {t: m.normal_force for t, m in truth.items()}
    breach = case.breach
    if breach is not None:
        begin = next((t for t, m in truth.items() if t >= begin and breach(m)), begin)
    first = nanoseconds(stops[0].header.stamp)
    return Reaction(
        list(dict.fromkeys(int(s.cause) for s in stops)),
        stops[0].reason,
        (first - begin) / MS,
        (nanoseconds(hold.header.stamp) - begin) / MS,
        force.get(first, 0.0),
        max(f for t, f in force.items() if t >= faulty.faulty_at),
        float(watcher.states[-1].speed),
    )


def table() -> str:
    """All cases, measured, as Markdown."""
    names = {int(value): name.removeprefix("CAUSE_") for name, value in vars(SupervisorState).items() if "CAUSE_" in name}
    text = "| what happens | causes | first stop | to the stop | to the hold | force then, highest |\n|---|---|---|---|---|---|\n"
    for case in CASES:
        r = react(case)
        times = f"{r.to_stop:.0f} ms | {r.to_hold:.0f} ms | {r.force_at_stop:.1f}, {r.peak_force:.1f} N"
        text += f"| {case} | {', '.join(names[cause] for cause in r.causes)} | {r.reason} | {times} |\n"
    return text


if __name__ == "__main__":
    print(table())
