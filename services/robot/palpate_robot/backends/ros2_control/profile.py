"""Profiles: what the driver has to know of a ROS 2 stack, as YAML files."""

from pathlib import Path
from typing import Final, Literal

from palpate_errors import UserError
from palpate_models.scenario.schema import CommandLevel, Robot
from palpate_models.section import Section, read_model
from palpate_robot.backends.ros2_control.rules import Stack

FOLDER: Final = Path(__file__).with_name("profiles")


class Profile(Section):
    """Topics and conventions of a stack; topics are relative to the namespace. `robot.driver` replaces what it sets."""

    stack: Stack | None = None
    """Rules of the emulator; none of them fits any other stack."""
    namespace: str = ""
    joint_states: str = "joint_states"
    """sensor_msgs/JointState of the controller manager's own rate, not a merged one."""
    controllers: dict[CommandLevel, str]
    """Controller by level of command: forward_command_controller, or crisp_controllers for `setpoint`."""
    ft_topic: str = "ft_sensor/wrench"
    ft_sign: Literal[1, -1] = 1
    """-1 if the wrench is that of the tool on the environment."""
    ft_weight: bool = True
    """True if the wrench includes the tool's weight."""
    effort_is_torque: bool = True
    """True if the effort of joint states is a joint torque with gravity [N m]."""
    speed_scaling: str | None = None
    """std_msgs/Float64 topic of the execution speed [%]."""
    program_running: str | None = None
    """std_msgs/Bool topic that is false while the arm takes no commands."""

    def topic(self, name: str) -> str:
        """Return a topic of this profile in its namespace, without the leading slash."""
        return "/".join(part.strip("/") for part in (self.namespace, name) if part)

    def commands(self, level: CommandLevel) -> str:
        """Return the topic of commands. Raises UserError if the profile has no controller of this level."""
        if level not in self.controllers:
            known = ", ".join(self.controllers)
            raise UserError(f"robot.level: {level}: the profile offers {known}; set robot.driver.controller or robot.level")
        controller = self.controllers[level]
        return self.topic("target_pose" if level is CommandLevel.SETPOINT else f"{controller}/commands")


def profile_of(robot: Robot) -> Profile:
    """Return the profile that `robot.driver` names, with its changes. Raises UserError."""
    given = robot.driver
    known = ", ".join(sorted(file.stem for file in FOLDER.glob("*.yaml")))
    name = given.profile or ""
    path = Path(name) if name.endswith((".yaml", ".yml")) else FOLDER / f"{name}.yaml"
    if not path.is_file():
        raise UserError(f"robot.driver.profile: {name or 'not set'}: expected {known}, or the path of a YAML file")
    profile = read_model(path, Profile)
    fields = ("namespace", "joint_states", "ft_topic", "ft_sign", "ft_weight")
    changes = {name: value for name in fields if (value := getattr(given, name)) is not None}
    if given.controller is not None:
        changes["controllers"] = {robot.level: given.controller}
    return profile.model_copy(update=changes)
