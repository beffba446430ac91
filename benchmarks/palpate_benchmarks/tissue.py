"""What a step costs: `python -m palpate_benchmarks.tissue`, or `measure()` for a benchmark table."""

from __future__ import annotations

import json
import time

import numpy as np

from palpate_models.breathing import BreathingCurve
from palpate_models.patient import Lesion, Phantom, Stiffness
from palpate_models.phantom import build_phantom
from palpate_models.wall import MEDIAN
from palpate_tissue.backends.winkler.tissue import WinklerTissue
from palpate_tissue.surface import SkinSurface

SPEED_MPS = 0.03
RADIUS_M = 0.015
DEPTH_M = 0.010


def measure(steps: int = 4000) -> dict[str, float]:
    """Cost of a step [us] on the default abdomen with one lesion, sliding at 30 mm/s at 10 mm depth.

    Median, 99th percentile and mean; the same of a wall that stiffens as the median person's, stepped in turns with it, and the
    ratio of the medians; and the numbers of vertices, of vertices in contact, and of sub-steps.
    """
    linear, stiffening = (_abdomen(beta) for beta in (0.0, MEDIAN.stiffening_per_m))
    model = linear.model
    surface = SkinSurface(model)
    velocity, spin = np.array((SPEED_MPS, 0.0, 0.0)), np.zeros(3)
    costs, contacts = np.empty((2, steps)), np.empty(steps)
    for k in range(steps):
        under = surface.nearest(np.array((-0.06 + SPEED_MPS * linear.dt * k, 0.01, 0.0)))
        p = under.position + (RADIUS_M - DEPTH_M) * under.normal
        turns = ((0, linear), (1, stiffening))
        for which, tissue in turns if k % 2 else reversed(turns):
            begin = time.perf_counter_ns()
            tissue.step(k * tissue.dt, p, velocity, RADIUS_M, spin)
            costs[which, k] = (time.perf_counter_ns() - begin) / 1e3
        contacts[k] = len(linear.contacts)
    median, late, mean = np.median(costs, axis=1), np.percentile(costs, 99, axis=1), costs.mean(axis=1)
    return {
        "vertices": len(model.vertices),
        "contacts": float(contacts.mean()),
        "substeps": linear.substeps,
        "step_us_p50": float(median[0]),
        "step_us_p99": float(late[0]),
        "step_us_mean": float(mean[0]),
        "stiffening_substeps": stiffening.substeps,
        "stiffening_step_us_p50": float(median[1]),
        "stiffening_step_us_p99": float(late[1]),
        "stiffening_step_us_mean": float(mean[1]),
        "stiffening_over_linear": float(median[1] / median[0]),
    }


def _abdomen(stiffening_per_m: float) -> WinklerTissue:
    stiffness = Stiffness(stiffening_per_m=stiffening_per_m)
    phantom = Phantom(stiffness=stiffness, lesions=(Lesion(centre_m=(-0.055, 0.01)),))
    return WinklerTissue(build_phantom(phantom, seed=0), stiffness, BreathingCurve(phantom.breathing, 0))


if __name__ == "__main__":
    print(json.dumps(measure(), indent=2))
