"""Makes the service of an image once, so that numba's compiled code and matplotlib's fonts are kept in the image."""

import sys
from importlib.util import find_spec

from palpate_bus.implementations import create
from palpate_models.load import load_scenario

COMPILED = ("robot", "robot-mujoco", "robot-lbr", "tissue", "tissue-elastic", "control", "planning", "supervisor")

if __name__ == "__main__":
    extra = sys.argv[1]
    if find_spec("matplotlib"):
        import matplotlib.font_manager  # noqa: F401
    if extra in COMPILED:
        scenario = load_scenario("rlq_guarding")
        role, _, name = extra.partition("-")
        create(role, name or getattr(scenario.services, role), scenario)
