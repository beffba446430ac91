"""Creates the service of an image once, so that numba's compiled code and matplotlib's fonts are cached in the image."""

import sys
from importlib import import_module
from importlib.util import find_spec

from palpate_bus.implementations import create

COMPILED = ("robot", "robot-mujoco", "tissue", "control", "planning", "supervisor")
"""Images whose service compiles code when it is created. The elastic tissue is left out: it would add 80 MB of matrices."""
STUDY = "study"
"""The image with all services of an examination."""

if __name__ == "__main__":
    image = sys.argv[1]
    if find_spec("matplotlib"):
        import_module("matplotlib.font_manager")
    for name in [one for one in COMPILED if "-" not in one] if image == STUDY else {image}.intersection(COMPILED):
        scenario = import_module("palpate_models.scenario.load").load_scenario("clean")
        role, _, backend = name.partition("-")
        create(role, backend or getattr(scenario.services, role), scenario)
