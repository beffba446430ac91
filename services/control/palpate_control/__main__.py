"""`python -m palpate_control [NAME_OR_FILE]`: the control as a process of its own."""

from palpate_bus.run import main
from palpate_models.scenario.load import load_scenario

if __name__ == "__main__":
    main("control", load_scenario)
