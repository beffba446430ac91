"""The robot on the bus with MuJoCo behind it; driver, sensor and messages are `palpate_robot`'s."""

from __future__ import annotations

from palpate_models.load import exam_input
from palpate_models.scenario import Scenario
from palpate_robot.backends.mujoco.plant import Plant
from palpate_robot.service import RobotService


def create(scenario: Scenario) -> RobotService:
    """The robot of a scenario; it gets no phantom."""
    return RobotService(exam_input(scenario), Plant)
