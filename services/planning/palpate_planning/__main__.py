"""`python -m palpate_planning [NAME_OR_FILE]`: the planning as a process of its own."""

from palpate_bus.run import main
from palpate_models.scenario.load import load_scenario

if __name__ == "__main__":
    main("planning", load_scenario)
