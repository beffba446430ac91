"""`python -m palpate_robot [NAME_OR_FILE]`: the robot as a process of its own."""

from palpate_bus.run import main
from palpate_models.scenario.load import load_scenario

if __name__ == "__main__":
    main("robot", load_scenario)
