"""Robot service with MuJoCo physics."""

from palpate_models.scenario.load import plant_input
from palpate_models.scenario.schema import Scenario
from palpate_robot.backends.mujoco.plant import MujocoPlant
from palpate_robot.service import RobotService


def create(scenario: Scenario) -> RobotService:
    """Return the robot of a scenario; it has the plant input only, so nothing of the patient."""
    return RobotService(plant_input(scenario), MujocoPlant)
