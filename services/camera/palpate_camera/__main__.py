"""Runs the role as a process: `python -m palpate_camera`."""

from palpate_bus.run import main
from palpate_camera.backends.kinect.service import create
from palpate_models.load import load_scenario

if __name__ == "__main__":
    main("camera", create, load_scenario)
