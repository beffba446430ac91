"""The driver of a KUKA LBR behind lbr_fri_ros2_stack: LBRState and F/T readings in, torque overlay out."""

from typing import Final

import numpy as np

from palpate_bus.settings import BusConfigError, Settings
from palpate_models.scenario.load import exam_input
from palpate_models.scenario.schema import CommandLevel, ExamInput, Scenario
from palpate_robot.backends.arm_port import ArmPort
from palpate_robot.backends.hardware import HardwareService, InnerLoop
from palpate_robot.backends.lbr.port import MeasuredLbr, ZenohPort

DAMPING: Final = np.array([40.0, 40.0, 20.0, 20.0, 8.0, 8.0, 8.0])
"""Maximum joint damping in a hold [N m s/rad] (assumed). The overlay is one to three cycles late, on a filtered speed. Below the
arm's viscous friction (10) it is stable with any delay; joints with enough inertia take more."""


def lbr_service(exam: ExamInput, port: ArmPort, inner: InnerLoop | None = None) -> HardwareService:
    """Return the driver on a port; `inner` follows set-points in its process."""
    given = exam.robot.driver
    sign, weight = given.ft_sign or 1, given.ft_weight is not False
    return HardwareService(exam, port, MeasuredLbr(), DAMPING, ft_sign=sign, ft_weight=weight, inner=inner)


def create(scenario: Scenario) -> HardwareService:
    """Return the driver of a scenario, connected to the ROS side that `robot.driver` names."""
    if Settings.read().runtime != "wallclock":
        raise BusConfigError("services.robot = lbr drives hardware and cannot run in simulated time: use --wallclock")
    exam = exam_input(scenario)
    inner = InnerLoop(scenario) if exam.robot.level is CommandLevel.SETPOINT else None
    return lbr_service(exam, ZenohPort(exam.robot.driver), inner)
