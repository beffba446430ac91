"""`python -m palpate_robot`: the robot as a process of its own."""

from palpate_bus.run import main
from palpate_models.load import load_scenario
from palpate_robot.backends.dart.service import create

if __name__ == "__main__":
    main("robot", create, load_scenario)
