"""What a step costs: `python -m palpate_benchmarks.tissue`, or `measure()` for a benchmark table."""

from __future__ import annotations

import json
from functools import partial

import numpy as np

from palpate_benchmarks.turns import compared, in_turns
from palpate_models.patient.breathing import BreathingCurve
from palpate_models.patient.phantom import build_phantom
from palpate_models.patient.schema import Lesion, Phantom, Stiffness
from palpate_models.patient.wall import MEDIAN
from palpate_tissue.backends.winkler.tissue import WinklerTissue
from palpate_tissue.surface import SkinSurface

SPEED_MPS = 0.03
RADIUS_M = 0.015
DEPTH_M = 0.010


def measure(steps: int = 4000) -> dict[str, float]:
    """Cost of a step [us] on the default abdomen with one lesion, sliding at 30 mm/s at 10 mm depth.

    Processor time of a wall that does not stiffen and of one that stiffens as the median person's, stepped in turns, and their
    ratios; and the numbers of vertices, of vertices in contact, and of sub-steps.
    """
    linear, stiffening = (_abdomen(beta) for beta in (0.0, MEDIAN.stiffening_per_m))
    model = linear.model
    surface = SkinSurface(model)
    velocity, spin = np.array((SPEED_MPS, 0.0, 0.0)), np.zeros(3)

    def step(tissue: WinklerTissue, k: int) -> None:
        tissue.step(k * tissue.dt, path[k], velocity, RADIUS_M, spin)

    path = []
    for k in range(steps):
        under = surface.nearest(np.array((-0.06 + SPEED_MPS * linear.dt * k, 0.01, 0.0)))
        path.append(under.position + (RADIUS_M - DEPTH_M) * under.normal)

    costs = in_turns([partial(step, linear), partial(step, stiffening)], steps)
    return {
        "vertices": len(model.vertices),
        "contacts": float(len(linear.contacts)),
        "substeps": linear.substeps,
        "stiffening_substeps": stiffening.substeps,
        **compared(costs, ("step", "stiffening_step")),
    }


def _abdomen(stiffening_per_m: float) -> WinklerTissue:
    stiffness = Stiffness(stiffening_per_m=stiffening_per_m)
    phantom = Phantom(stiffness=stiffness, lesions=(Lesion(centre_m=(-0.055, 0.01)),))
    return WinklerTissue(build_phantom(phantom, seed=0), stiffness, BreathingCurve(phantom.breathing, 0))


if __name__ == "__main__":
    print(json.dumps(measure(), indent=2))
