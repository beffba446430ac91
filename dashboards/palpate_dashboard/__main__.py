"""`python -m palpate_dashboard [NAME_OR_FILE]`: the dashboard as a separate process."""

from palpate_bus.run import main
from palpate_models.scenario.load import load_scenario

if __name__ == "__main__":
    main("dashboard", load_scenario)
