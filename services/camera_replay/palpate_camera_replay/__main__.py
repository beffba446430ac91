"""`python -m palpate_camera_replay`: the camera as a process of its own."""

from palpate_bus.run import main
from palpate_models.load import load_scenario

from palpate_camera_replay.service import create

if __name__ == "__main__":
    main("camera", create, load_scenario)
