"""`python -m palpate_control`: the control service as a process."""

from palpate_bus.run import main
from palpate_control.service import create
from palpate_models.load import load_scenario

if __name__ == "__main__":
    main("control", create, load_scenario)
