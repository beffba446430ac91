"""Runs the role as a process: `python -m palpate_camera`."""

from palpate_bus.run import main
from palpate_models.load import load_scenario

from palpate_camera.service import create

if __name__ == "__main__":
    main("camera", create, load_scenario)
