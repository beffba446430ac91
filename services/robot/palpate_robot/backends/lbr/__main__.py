"""`python -m palpate_robot.backends.lbr`: the driver as a process of its own. It runs on the wall clock only."""

from palpate_bus.run import main
from palpate_models.load import load_scenario
from palpate_robot.backends.lbr.service import create

if __name__ == "__main__":
    main("robot", create, load_scenario)
