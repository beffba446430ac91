"""`python -m palpate_camera [NAME_OR_FILE]`: the camera as a process of its own."""

from palpate_bus.run import main
from palpate_models.scenario.load import load_scenario

if __name__ == "__main__":
    main("camera", load_scenario)
