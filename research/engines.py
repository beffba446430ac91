"""DART against MuJoCo for each arm: contact force and path of a press 10 mm deep: `python -m research.engines ARM...`."""

import sys
from typing import NamedTuple

import numpy as np

from palpate_planning.setpoints import NORMAL_STIFFNESS
from palpate_robot.backends.dart.plant import DartPlant
from palpate_robot.backends.mujoco.plant import MujocoPlant
from research.contact_rig import Delays, press


class Comparison(NamedTuple):
    """One press in both engines."""

    force_n: float
    """Mean force at the end in DART."""
    force_difference_n: float
    """Largest difference of the force at one time."""
    path_difference_m: float
    """Largest distance of the sphere's centres at one time."""


def compare(arm: str) -> Comparison:
    """Press the default wall with an arm in both engines."""
    dart, mujoco = (press(1.0, NORMAL_STIFFNESS, Delays(), arm, engine) for engine in (DartPlant, MujocoPlant))
    path = np.linalg.norm(dart.path - mujoco.path, axis=1).max()
    return Comparison(dart.mean_force, float(np.abs(dart.force - mujoco.force).max()), float(path))


def main() -> None:
    """Print a line for each arm."""
    print("arm  force [N]  largest difference of force [N]  of path [mm]")
    for arm in sys.argv[1:]:
        c = compare(arm)
        print(f"{arm}  {c.force_n:.2f}  {c.force_difference_n:.3f}  {1e3 * c.path_difference_m:.3f}")


if __name__ == "__main__":
    main()
