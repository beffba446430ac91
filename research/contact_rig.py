"""Robot, tissue and controller of a real run, without planning: pressed to a depth by a script, under bus delays.

The services are those that `palpate run` starts, in the composed runtime. The arm starts 5 mm above the umbilicus, in the
posture of an examination, presses 10 mm deep and holds; at `NUDGE_S` the set-point steps 0.5 mm deeper and back: what rings
long after that rings by itself.
"""

from collections import deque
from collections.abc import Callable, Iterable, Mapping
from copy import deepcopy
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np

from palpate_bus.contract import contract
from palpate_bus.messages import NS, Message
from palpate_bus.messages.geometry import vector
from palpate_bus.runtime.composed import Composed
from palpate_bus.service import Inbox, Outbox, Service
from palpate_bus.setpoint import TOPIC
from palpate_control.service import create as create_control
from palpate_models.numerics.frames import Array, matrix, rigid
from palpate_models.patient.motion import Breathing
from palpate_models.patient.schema import Background, Phantom, Stiffness
from palpate_models.robot.arm import arm_of
from palpate_models.scenario.errors import ArmErrors, DrawnArm, Errors
from palpate_models.scenario.load import plant_input, true_pose
from palpate_models.scenario.schema import CommandLevel, Robot, Scenario
from palpate_planning.motion.kinematics import ArmKinematics
from palpate_planning.setpoints import CARTESIAN_STIFFNESS, cartesian_setpoint, joint_setpoint
from palpate_planning.strokes.path import least_twist
from palpate_robot.backends.dart.plant import DartPlant
from palpate_robot.plant import Plant
from palpate_robot.service import RobotService
from palpate_tissue.backends.winkler.service import create as create_tissue

Observe = Callable[[int, Mapping[str, Any]], None]
"""Called with the time [ns] and the outbox of each step."""
Engine = Callable[[Robot, DrawnArm, Array], Plant]
"""A plant at rest at some joint positions."""
Script = Callable[[int], Mapping[str, Message]]
"""Messages that a topic without a producer is to bring at a time [ns]."""


class BusDelay:
    """Delay of messages of one topic: `delay_s`, and up to `jitter_s` more, uniform, in order."""

    def __init__(self, delay_s: float, jitter_s: float = 0.0, seed: int = 0) -> None:
        if delay_s < 0 or jitter_s < 0:
            raise ValueError(f"bus delay {delay_s} s with jitter {jitter_s} s: must not be negative")
        self._delay = round(delay_s * NS)
        self._jitter = round(jitter_s * NS)
        self._rng = np.random.Generator(np.random.PCG64(seed))
        self._last = 0

    def arrival(self, t: int) -> int:
        """When a message sent at `t` [ns] arrives [ns]; never before the one sent before it."""
        late = int(self._rng.integers(self._jitter + 1)) if self._jitter else 0
        self._last = max(self._last, t + self._delay + late)
        return self._last


class DelayedInbox:
    """An inbox some of whose topics bring their messages later, and some of which are scripted."""

    def __init__(self, delays: Mapping[str, BusDelay]) -> None:
        self._delays = delays
        self._under_way: dict[str, deque[tuple[int, int | None, Message]]] = {topic: deque() for topic in delays}
        self._new: dict[str, list[Message]] = {}
        self._latest: dict[str, tuple[int | None, Message]] = {}
        self._inbox: Inbox | None = None

    def advance(self, t: int, inbox: Inbox, scripted: Mapping[str, Message]) -> None:
        """Take what has been sent and hands on what has arrived by `t` [ns]."""
        self._inbox = inbox
        self._new = {topic: [message] for topic, message in scripted.items()}
        for topic, message in scripted.items():
            self._latest[topic] = (t, message)
        for topic, delay in self._delays.items():
            waiting = self._under_way[topic]
            for message in inbox.new(topic):
                waiting.append((delay.arrival(t), inbox.stamp(topic), message))
            arrived = self._new[topic] = []
            while waiting and waiting[0][0] <= t:
                _, stamp, message = waiting.popleft()
                arrived.append(message)
                self._latest[topic] = (stamp, message)

    def _mine(self, topic: str) -> bool:
        return topic in self._delays or topic in self._latest

    @property
    def _real(self) -> Inbox:
        if self._inbox is None:
            raise RuntimeError("a delayed inbox is read before its first step")
        return self._inbox

    def latest(self, topic: str) -> Message | None:
        """Return the newest message that has arrived."""
        if self._mine(topic):
            return self._latest[topic][1] if topic in self._latest else None
        return self._real.latest(topic)

    def new(self, topic: str) -> Iterable[Message]:
        """Yield the messages since the last step."""
        return self._new.get(topic, []) if self._mine(topic) else self._real.new(topic)

    def stamp(self, topic: str) -> int | None:
        """When the newest message that has arrived was sent [ns]."""
        if self._mine(topic):
            return self._latest[topic][0] if topic in self._latest else None
        return self._real.stamp(topic)

    def lost(self, role: str) -> bool:
        """Return True if the service of that role is lost."""
        return self._real.lost(role)


class Delayed(Service):
    """A service whose messages come late. Its role is the inner service's."""

    def __init__(
        self, inner: Service, delays: Mapping[str, BusDelay], observe: Observe | None = None, script: Script | None = None
    ) -> None:
        self.role = inner.role  # type: ignore[misc]  # of the instance: one wrapper for every role
        self._inner = inner
        self._inbox = DelayedInbox(delays)
        self._observe = observe
        self._script = script

    def start(self) -> Outbox:
        """Return the inner service's latched messages."""
        return self._inner.start()

    def step(self, t: int, inbox: Inbox) -> Outbox:
        """A step of the inner service on what has arrived."""
        self._inbox.advance(t, inbox, self._script(t) if self._script else {})
        outbox = self._inner.step(t, self._inbox)
        if self._observe:
            self._observe(t, outbox)
        return outbox

    def finish(self) -> Mapping[str, Any]:
        """Return the inner service's facts."""
        return self._inner.finish()


DEPTH_M = 0.010
ABOVE_M = 0.005
BEGIN_S, PRESS_S, NUDGE_S, END_S = 0.08, 0.48, 0.8, 1.6
NUDGE_M, NUDGE_FOR_S = 0.0005, 0.05
WATCH_S = 0.3
"""The end of the run, over which ringing is measured [s]."""
EVENTS = ("joint_states", "control/joint_torque", "sim/tool_state", "sim/contact_wrench", "robot/status")
CONTROL_PATH = (*EVENTS[:2], "robot/status")
"""Messages that a real robot sends over its bus; control reads the F/T sensor from the status if it commands positions."""
CONTACT_PATH = EVENTS[2:4]
"""Messages of the co-simulation only: on hardware robot and tissue touch."""


@dataclass(frozen=True)
class Delays:
    """Delay and jitter [s] on each message of the given topics; a path's loop holds two of them."""

    topics: tuple[str, ...] = EVENTS
    delay_s: float = 0.0
    jitter_s: float = 0.0
    seed: int = 0

    def on(self, *topics: str) -> dict[str, BusDelay]:
        """Return the delays among `topics`, each with a random stream of its own."""
        return {
            topic: BusDelay(self.delay_s, self.jitter_s, 100 * self.seed + EVENTS.index(topic))
            for topic in topics
            if topic in self.topics
        }


@dataclass(frozen=True)
class Ringing:
    """Course of a contact; arrays of shape (n,), one value per millisecond."""

    time: Array
    """[s]"""
    force: Array
    """Force of the tissue on the indenter, along the vertical [N]."""
    held: bool
    """True if the driver went into its safe hold."""
    path: Array
    """Centre of the sphere in world [m], shape (n, 3)."""

    def _swing(self, start: float) -> float:
        part = self.force[(self.time >= start) & (self.time < start + WATCH_S)]
        return float(np.ptp(part - np.polyval(np.polyfit(np.arange(len(part)), part, 1), np.arange(len(part)))))

    @property
    def mean_force(self) -> float:
        """Over the end of the run [N]."""
        return float(self.force[self.time >= self.time[-1] - WATCH_S].mean())

    @property
    def swing(self) -> float:
        """Peak to peak at the end of the run, drift taken out [N]."""
        return self._swing(END_S - WATCH_S)

    @property
    def stable(self) -> bool:
        """True if the ringing decays: no safe hold, contact kept, at most 5 % of the force left swinging (and 0.05 N)."""
        return not self.held and self.mean_force > 0.1 and self.swing < max(0.05, 0.05 * self.mean_force)


DEFAULT_ARM = Robot().arm


@cache
def scenario(contrast: float, arm: str = DEFAULT_ARM) -> Scenario:
    """A uniform abdomen that does not breathe, `contrast` times the default's stiffness, on a robot with almost no noise."""
    wall = Stiffness(k_w_n_per_m3=Stiffness().k_w_n_per_m3 * contrast)
    plain = Scenario()
    still = Errors(level="none", arm=ArmErrors(position_noise_rad=1e-9, velocity_noise_radps=1e-9))  # no sensor repeats itself
    held = Breathing(kind="none")
    phantom = Phantom(stiffness=wall, background=Background(cv=0.0, margins=1.0), edge_m=0.006, breathing=held)
    return plain.model_copy(update={"phantom": phantom, "errors": still, "robot": Robot.model_validate({"arm": arm})})


@cache
def _tissue(contrast: float) -> Service:
    """Return a tissue that has not been touched; a run takes a copy of it."""
    return create_tissue(scenario(contrast))


@dataclass
class _Script:
    """Set-points as planning would send them."""

    contrast: float
    stiffness: float
    arm: str = DEFAULT_ARM
    ready: Array = field(init=False)
    """Joint positions at the start."""
    R: Array = field(init=False)
    top: Array = field(init=False)

    def __post_init__(self) -> None:
        chosen = scenario(self.contrast, self.arm)
        kinematics, home = ArmKinematics(chosen.robot, chosen.limits), arm_of(chosen.robot).home_rad
        self._tares = chosen.robot.level is CommandLevel.POSITION
        self.R = least_twist(np.array((0.0, 0.0, -1.0)), kinematics.pose(home)[:3, :3])
        self.top = matrix(true_pose(chosen))[:3, 3] + (0.0, 0.0, chosen.robot.indenter_radius_m)
        self.ready = kinematics.solve(self._at(-ABOVE_M), home).q

    def _at(self, depth: float) -> Array:
        return rigid(self.R, self.top - (0.0, 0.0, depth))

    def depth(self, t: float) -> float:
        """Depth of the set-point below the skin at rest [m] at time `t` [s]."""
        if t < PRESS_S:
            return -ABOVE_M + (DEPTH_M + ABOVE_M) * _smooth((t - BEGIN_S) / (PRESS_S - BEGIN_S))
        return DEPTH_M + (NUDGE_M if NUDGE_S <= t < NUDGE_S + NUDGE_FOR_S else 0.0)

    def __call__(self, t: int) -> Mapping[str, Message]:
        if t % contract().topics[TOPIC].period:
            return {}
        now = t / NS
        if self._tares and now < BEGIN_S:  # in free motion control learns the bias of the F/T sensor
            still = np.zeros_like(self.ready)
            return {TOPIC: joint_setpoint(t, self._at(-ABOVE_M), self.ready, still, still).message()}
        setpoint = cartesian_setpoint(t, self.R, self._at(self.depth(now))[:3, 3], self.ready)
        stiffness = CARTESIAN_STIFFNESS * (1, 1, self.stiffness / CARTESIAN_STIFFNESS[2], 1, 1, 1)
        return {TOPIC: setpoint._replace(stiffness=stiffness).message()}


def _smooth(t: float) -> float:
    t = min(max(t, 0.0), 1.0)
    return t * t * t * (10 - 15 * t + 6 * t * t)


def start_posture(contrast: float = 1.0) -> Array:
    """Joint positions in which a run starts [rad], shape (7,)."""
    return _Script(contrast, 0.0).ready


@cache
def press(contrast: float, stiffness: float, delays: Delays, arm: str = DEFAULT_ARM, engine: Engine = DartPlant) -> Ringing:
    """Press a wall `contrast` times as stiff as the default, with a controller of `stiffness` [N/m] along the tool.

    Runs repeat exactly, so one that has been made is remembered.
    """
    chosen = scenario(contrast, arm)
    time, force, modes, path = [], [], [], []

    def see_wrench(t: int, outbox: Mapping[str, Any]) -> None:
        time.append(t / NS)
        force.append(outbox["sim/contact_wrench"].wrench.force.z)

    def see_robot(_: int, outbox: Mapping[str, Any]) -> None:
        path.append(vector(outbox["sim/tool_state"].pose.position))
        if "robot/status" in outbox:
            modes.append(outbox["robot/status"].mode)

    script = _Script(contrast, stiffness, arm)
    robot = RobotService(plant_input(chosen), lambda robot, *, drawn: engine(robot, drawn, script.ready))
    run = Composed(
        [
            Delayed(robot, delays.on("control/joint_torque", "sim/contact_wrench"), see_robot),
            Delayed(deepcopy(_tissue(contrast)), delays.on("sim/tool_state"), see_wrench),
            Delayed(create_control(chosen), delays.on("joint_states", "robot/status"), script=script),
        ]
    )
    run.run(lambda: None, round(END_S * NS))
    return Ringing(np.array(time), np.array(force), 2 in modes, np.array(path))
