"""Makes the service of an image once, so that numba's compiled code and matplotlib's fonts are kept in the image."""

import sys
from importlib.metadata import entry_points
from importlib.util import find_spec

from palpate_models.load import load_scenario

COMPILED = ("robot", "robot-mujoco", "robot-lbr", "tissue", "tissue-elastic", "control", "planning", "supervisor")

if __name__ == "__main__":
    extra = sys.argv[1]
    if find_spec("matplotlib"):
        import matplotlib.font_manager  # noqa: F401
    if extra in COMPILED:
        points = {
            point.name: point for group in ("palpate.services", "palpate.implementations") for point in entry_points(group=group)
        }
        points[extra.replace("-", ".")].load()(load_scenario("rlq_guarding"))
