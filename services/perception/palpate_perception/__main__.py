"""Runs the role as a process: `python -m palpate_perception`."""

from palpate_bus.run import main
from palpate_models.load import load_scenario
from palpate_perception.service import create

if __name__ == "__main__":
    main("perception", create, load_scenario)
