"""Runs the recorder on the bus."""

from palpate_bus.run import main
from palpate_models.load import load_scenario
from palpate_recorder.service import create

if __name__ == "__main__":
    main("recorder", create, load_scenario)
