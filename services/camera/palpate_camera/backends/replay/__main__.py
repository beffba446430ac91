"""`python -m palpate_camera.backends.replay`: the camera as a process of its own."""

from palpate_bus.run import main
from palpate_camera.backends.replay.service import create
from palpate_models.load import load_scenario

if __name__ == "__main__":
    main("camera", create, load_scenario)
