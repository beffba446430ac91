"""`python -m palpate_camera.backends.ros`: the bridge as a process of its own. It runs on the wall clock only."""

from palpate_bus.run import main
from palpate_camera.backends.ros.service import create
from palpate_models.load import load_scenario

if __name__ == "__main__":
    main("camera", create, load_scenario)
