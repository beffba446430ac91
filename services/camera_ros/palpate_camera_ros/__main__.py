"""`python -m palpate_camera_ros`: the bridge as a process of its own. It runs on the wall clock only."""

from palpate_bus.run import main
from palpate_models.load import load_scenario

from palpate_camera_ros.service import create

if __name__ == "__main__":
    main("camera", create, load_scenario)
