"""`python -m palpate_assessment [NAME_OR_FILE]`: the assessment as a process of its own."""

from palpate_bus.run import main
from palpate_models.scenario.load import load_scenario

if __name__ == "__main__":
    main("assessment", load_scenario)
