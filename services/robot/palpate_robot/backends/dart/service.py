"""Robot service with DART physics."""

from palpate_models.scenario.load import plant_input
from palpate_models.scenario.schema import Scenario
from palpate_robot.backends.dart.plant import DartPlant
from palpate_robot.service import RobotService


def create(scenario: Scenario) -> RobotService:
    """Return the robot of a scenario; it uses the plant input only."""
    return RobotService(plant_input(scenario), DartPlant)
