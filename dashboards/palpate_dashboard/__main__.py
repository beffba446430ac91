"""Runs the dashboard on the bus."""

from palpate_bus.run import main
from palpate_dashboard.service import create
from palpate_models.load import load_scenario

if __name__ == "__main__":
    main("dashboard", create, load_scenario)
