"""Makes the service of an image once, so that numba's compiled code and matplotlib's fonts are kept in the image."""

import sys
from importlib import import_module
from importlib.util import find_spec

from palpate_bus.implementations import create

COMPILED = ("robot", "robot-mujoco", "tissue", "control", "planning", "supervisor")
"""Extras whose service is made in simulated time and compiles something; the elastic tissue would leave 80 MB of its matrices."""

if __name__ == "__main__":
    extra = sys.argv[1]
    if find_spec("matplotlib"):
        import_module("matplotlib.font_manager")
    if extra in COMPILED:
        scenario = import_module("palpate_models.load").load_scenario("clean")
        role, _, name = extra.partition("-")
        create(role, name or getattr(scenario.services, role), scenario)
