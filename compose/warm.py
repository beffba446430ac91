"""Makes the service of an image once, so that numba's compiled code and matplotlib's fonts are kept in the image."""

import sys
from importlib import import_module
from importlib.util import find_spec

from palpate_bus.implementations import create

COMPILED = ("robot", "robot-mujoco", "tissue", "control", "planning", "supervisor")
"""Extras whose service is made in simulated time and compiles something; the elastic tissue would leave 80 MB of its matrices."""
STUDY = "study"
"""The extra that has all services of an examination in one image."""

if __name__ == "__main__":
    extra = sys.argv[1]
    if find_spec("matplotlib"):
        import_module("matplotlib.font_manager")
    for name in [one for one in COMPILED if "-" not in one] if extra == STUDY else {extra}.intersection(COMPILED):
        scenario = import_module("palpate_models.scenario.load").load_scenario("clean")
        role, _, backend = name.partition("-")
        create(role, backend or getattr(scenario.services, role), scenario)
