"""Rules of two arms behind ros2_control, as their controllers apply them to commands: README.md has a table with their sources.

Arrays in, arrays out; no physics, no messages.
"""

from abc import ABC, abstractmethod
from enum import StrEnum
from typing import ClassVar, Final, NamedTuple

import numpy as np

from palpate_errors import UserError
from palpate_models.numerics.frames import Array
from palpate_models.robot.chain import Arm
from palpate_models.scenario.schema import CommandLevel


class Stack(StrEnum):
    """Arms whose rules are emulated."""

    FRANKA = "franka"
    UR = "ur"


class Sensed(NamedTuple):
    """Measurements of an arm in a cycle."""

    q: Array
    """Joint positions [rad], shape (n,)."""
    v: Array
    """Joint velocities [rad/s], shape (n,)."""
    force_n: float
    """External force at the tool."""
    torque_nm: Array
    """External joint torques, shape (n,)."""


class Rules(ABC):
    """Turns the commands of an arm into what its joints follow, cycle by cycle."""

    period_ms: ClassVar[int]
    ranges: ClassVar[dict[str, tuple[float, float]]] = {}
    """Allowed numbers of settings."""
    commands: ClassVar[CommandLevel]

    def __init__(self, arm: Arm) -> None:
        self._arm = arm
        self._dt = self.period_ms * 1e-3
        self.settings = {"controller": 1.0}
        """Numbers that events set, by name."""
        self.stopped = ""
        """Reason of the arm's own stop, empty while there is none."""

    @property
    def publishes(self) -> bool:
        """True while the ROS side publishes joint states."""
        return True

    @property
    def program(self) -> bool | None:
        """State of the stack's program on the arm; None if the stack has none."""
        return None

    @property
    def runs(self) -> bool:
        """True while commands have an effect."""
        return not self.stopped and bool(self.settings["controller"])

    def setting(self, text: str) -> tuple[str, float]:
        """Return name and number of an event, such as `speed 0.5`. Raises UserError for an unknown one."""
        name, _, value = text.partition(" ")
        try:
            number = float(value)
        except ValueError:
            number = np.nan
        low, high = self.ranges.get(name, (0.0, np.inf))
        if not low <= number <= high or name not in (*self.settings, "recover"):
            names = ", ".join((*self.settings, "recover"))
            raise UserError(f"robot.driver.events: {text!r}: expected one of {names}, then {low:g} to {high:g}")
        return name, number

    def event(self, text: str) -> None:
        """Apply an event. Raises UserError for an unknown one."""
        name, number = self.setting(text)
        if name == "recover":
            self._recover()
        else:
            self.settings[name] = number

    def _recover(self) -> None:
        """End a stop by hand."""
        self.stopped = ""

    @abstractmethod
    def cycle(self, sensed: Sensed, command: Array | None) -> Array | None:
        """Return what the joints follow in this cycle, torques [N m] or positions [rad], shape (n,); None if the arm stands.

        `command` is the newest command of the controller, None before the first.
        """


class FrankaRules(Rules):
    """A Franka behind franka_ros2, commanded by joint torques."""

    period_ms = 1
    commands = CommandLevel.TORQUE
    RATE_NMPS: Final = 1000.0
    LOST_CYCLES: Final = 20

    def __init__(self, arm: Arm) -> None:
        super().__init__(arm)
        self.settings |= {"limiter": 1.0, "collision": 50.0, "collision_torque": 40.0, "lose": 0.0}
        self._torque = np.zeros(arm.joints)
        self._lost = 0

    @property
    def publishes(self) -> bool:
        """False in a reflex: ros2_control_node has ended."""
        return not self.stopped

    def cycle(self, sensed: Sensed, command: Array | None) -> Array | None:
        """See `Rules.cycle`."""
        if not self.runs:
            self._torque, self._lost = np.zeros(self._arm.joints), 0
            return None
        settings = self.settings
        if settings["lose"] > 0:
            settings["lose"] -= 1
            self._lost += 1
        else:
            self._lost = 0
            self._take(np.zeros(self._arm.joints) if command is None else command)
        if self._lost >= self.LOST_CYCLES:
            self.stopped = "communication_constraints_violation"
        elif sensed.force_n > settings["collision"]:
            self.stopped = "cartesian_reflex"
        elif np.any(np.abs(sensed.torque_nm) > settings["collision_torque"]):
            self.stopped = "joint_reflex"
        elif np.any(np.abs(sensed.v) > self._arm.velocity_radps):
            self.stopped = "joint_velocity_violation"
        return None if self.stopped else self._torque

    def _take(self, command: Array) -> None:
        step = self.RATE_NMPS * self._dt
        clipped = self._torque + np.clip(command - self._torque, -step, step)
        if not self.settings["limiter"] and np.any(np.abs(command - clipped) > 1e-9):
            self.stopped = "controller_torque_discontinuity"
        self._torque = clipped


class UrRules(Rules):
    """A Universal Robots arm behind ur_robot_driver, commanded by joint positions (`servoj`)."""

    period_ms = 2
    ranges: ClassVar = {"lookahead": (0.03, 0.2), "speed": (0.0, 1.0)}
    LOCKED_S: Final = 5.0
    """Time after a protective stop in which it cannot be unlocked."""
    commands = CommandLevel.POSITION
    IGNORE_RADPS: Final = 20.0

    def __init__(self, arm: Arm) -> None:
        super().__init__(arm)
        self.settings |= {"lookahead": 0.03, "speed": 1.0, "remote": 1.0, "protective": 50.0}
        self._target: Array | None = None
        self._reference: Array | None = None
        self._stood_s = 0.0

    @property
    def program(self) -> bool:
        """False in a protective stop and without remote control."""
        return not self.stopped and bool(self.settings["remote"])

    @property
    def runs(self) -> bool:
        """False also while the external control program does not run."""
        return super().runs and self.program

    def cycle(self, sensed: Sensed, command: Array | None) -> Array | None:
        """See `Rules.cycle`. The reference follows the target with the lag of the look-ahead time (assumed)."""
        if sensed.force_n > self.settings["protective"]:
            self.stopped = "protective stop"
        self._stood_s = self._stood_s + self._dt if self.stopped else 0.0
        if not self.runs:
            self._target = self._reference = None
            return None
        if self._target is None or self._reference is None:
            self._target = self._reference = sensed.q
        step = self.IGNORE_RADPS * self._dt
        if command is not None and any(np.all(np.abs(command - near) <= step) for near in (self._target, sensed.q)):
            self._target = command
        speed = self.settings["speed"]
        share = 1.0 - np.exp(-self._dt * speed / self.settings["lookahead"])
        max_step = self._arm.velocity_radps * speed * self._dt
        self._reference = self._reference + np.clip(share * (self._target - self._reference), -max_step, max_step)
        return self._reference

    def _recover(self) -> None:
        if self._stood_s >= self.LOCKED_S:
            super()._recover()


RULES: Final[dict[Stack, type[Rules]]] = {Stack.FRANKA: FrankaRules, Stack.UR: UrRules}
