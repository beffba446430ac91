"""The robot on the bus with MuJoCo behind it; driver, sensor and messages are common to all simulated arms."""

from __future__ import annotations

from palpate_models.scenario.load import plant_input
from palpate_models.scenario.schema import Scenario
from palpate_robot.backends.mujoco.plant import MujocoPlant
from palpate_robot.service import RobotService


def create(scenario: Scenario) -> RobotService:
    """The robot of a scenario, of which it may know the equipment."""
    return RobotService(plant_input(scenario), MujocoPlant)
