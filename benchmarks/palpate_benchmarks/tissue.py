"""What a step costs: `python -m palpate_benchmarks.tissue`, or `measure()` for a benchmark table."""

from __future__ import annotations

import json
import time

import numpy as np

from palpate_models.breathing import BreathingCurve
from palpate_models.patient import Lesion, Phantom
from palpate_models.phantom import build_phantom
from palpate_tissue.backends.winkler.tissue import WinklerTissue
from palpate_tissue.surface import SkinSurface

SPEED_MPS = 0.03
RADIUS_M = 0.015
DEPTH_M = 0.010


def measure(steps: int = 4000) -> dict[str, float]:
    """Cost of a step [us] on the default abdomen with one lesion, sliding at 30 mm/s at 10 mm depth.

    Median, 99th percentile and mean; and the numbers of vertices, of vertices in contact, and of sub-steps.
    """
    phantom = Phantom(lesions=(Lesion(centre_m=(-0.055, 0.01)),))
    model = build_phantom(phantom, seed=0)
    tissue = WinklerTissue(model, phantom.stiffness, BreathingCurve(phantom.breathing, 0))
    surface = SkinSurface(model)
    velocity, spin = np.array((SPEED_MPS, 0.0, 0.0)), np.zeros(3)
    costs, contacts = np.empty(steps), np.empty(steps)
    for k in range(steps):
        under = surface.nearest(np.array((-0.06 + SPEED_MPS * tissue.dt * k, 0.01, 0.0)))
        p = under.position + (RADIUS_M - DEPTH_M) * under.normal
        begin = time.perf_counter_ns()
        tissue.step(k * tissue.dt, p, velocity, RADIUS_M, spin)
        costs[k] = (time.perf_counter_ns() - begin) / 1e3
        contacts[k] = len(tissue.contacts)
    return {
        "vertices": len(model.vertices),
        "contacts": float(contacts.mean()),
        "substeps": tissue.substeps,
        "step_us_p50": float(np.median(costs)),
        "step_us_p99": float(np.percentile(costs, 99)),
        "step_us_mean": float(costs.mean()),
    }


if __name__ == "__main__":
    print(json.dumps(measure(), indent=2))
