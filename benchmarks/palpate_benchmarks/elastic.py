"""What a step costs: `python -m palpate_benchmarks.elastic`; with `--sizes` against the number of vertices, for both tiers.

`measure()` is for a benchmark table. Median, 99th percentile and maximum are wall time; mean and real-time factor are of
processor time, so that they can be read on a busy machine too.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from palpate_benchmarks.turns import compared, in_turns
from palpate_bus.contract import contract
from palpate_models.numerics.frames import Array
from palpate_models.patient.breathing import BreathingCurve
from palpate_models.patient.guarding import Guarding
from palpate_models.patient.phantom import PhantomModel, build_phantom, flat_phantom
from palpate_models.patient.schema import Lesion, Phantom, Stiffness
from palpate_tissue.backend import TissueBackend
from palpate_tissue.backends.elastic.compliance import Compliance, SizeError, compliance
from palpate_tissue.backends.elastic.tissue import ElasticTissue
from palpate_tissue.backends.winkler.mechanics import StabilityError
from palpate_tissue.backends.winkler.tissue import WinklerTissue
from palpate_tissue.surface import SkinSurface

SPEED_MPS = 0.03
RADIUS_M = 0.015
DEPTH_M = 0.010
MUSCLE = Guarding(centre_m=(-0.03, 0.01))
"""Under the whole path of `measure`."""
SIZES = (1_000, 3_000, 10_000, 50_000)
SURFACE_EVERY = contract().topics["sim/surface"].period // contract().roles["tissue"].period
"""Steps between two messages of the deformed surface."""
_HALF_M = 0.13
"""Half width of the flat patch of the size sweep [m], as large as an abdomen's front."""


def measure(steps: int = 4000) -> dict[str, float]:
    """Cost of a step [us] on the default abdomen with a lesion 10 mm below the skin, sliding at 30 mm/s at 10 mm depth.

    The surface is included in its step; the time to load [s] is from the cache if it was computed before. Then processor time
    without stiffening, with it, and with voluntary guarding beside it, stepped in turns on the same solid and without the
    surface, and the ratios of these to the first.
    """
    phantom = Phantom(lesions=(Lesion(centre_m=(-0.055, 0.01), depth_m=0.01),))
    model = build_phantom(phantom, seed=0)
    begin = time.perf_counter()
    solid = compliance(model, phantom.lesions)
    tissue = ElasticTissue(model, solid, phantom.stiffness, BreathingCurve(phantom.breathing, 0))
    load = time.perf_counter() - begin
    surface = SkinSurface(model)
    path = []
    for k in range(steps):
        under = surface.nearest(np.array((-0.06 + SPEED_MPS * tissue.dt * k, 0.01, 0.0)))
        path.append(under.position + (RADIUS_M - DEPTH_M) * under.normal)
    figures = {"vertices": len(model.vertices), "load_s": load, **_slide(tissue, np.array(path), tissue.dt)}
    linear = replace(model, stiffening=np.zeros_like(model.stiffening))
    guarding = replace(build_phantom(phantom.model_copy(update={"guarding": (MUSCLE,)}), seed=0), voluntary=True)
    ways = [partial(_step, ElasticTissue(body, solid, phantom.stiffness), path) for body in (linear, model, guarding)]
    costs = in_turns(ways, steps)
    return {
        **figures,
        **compared(costs[:2], ("linear", "stiffening")),
        **compared(costs[[0, 2]], ("linear", "guarding")),
    }


def _step(body: TissueBackend, path: Sequence[Array], k: int) -> None:
    body.step(k * body.dt, path[k], np.array((SPEED_MPS, 0.0, 0.0)), RADIUS_M)


def _slide(body: TissueBackend, path: Array, dt: float) -> dict[str, float]:
    velocity, spin = np.array((SPEED_MPS, 0.0, 0.0)), np.zeros(3)
    costs, contacts = np.empty(len(path)), np.empty(len(path))
    before = time.thread_time_ns()
    for k, p in enumerate(path):
        begin = time.perf_counter_ns()
        body.step(k * dt, p, velocity, RADIUS_M, spin)
        if k % SURFACE_EVERY == 0:
            _ = body.deformed_vertices
        costs[k] = (time.perf_counter_ns() - begin) / 1e3
        contacts[k] = len(body.contacts)
    mean = (time.thread_time_ns() - before) / 1e3 / len(path)
    return {
        "contacts": float(contacts.mean()),
        "step_us_p50": float(np.median(costs)),
        "step_us_p99": float(np.percentile(costs, 99)),
        "step_us_max": float(costs.max()),
        "step_us_mean": mean,
        "real_time_factor": 1e6 * dt / mean,
    }


def flat_patch(vertices: int) -> PhantomModel:
    """A flat square, as large as an abdomen's front, of about so many vertices."""
    edge = 2 * _HALF_M / math.sqrt(vertices * math.sqrt(3) / 2)
    return flat_phantom(_HALF_M, edge)


def measure_size(vertices: int, tier: str, steps: int = 1000) -> dict[str, Any]:
    """Cost of a step of a tier, `surface` or `elastic`, on a flat patch of about so many vertices; or why it cannot."""
    model = flat_patch(vertices)
    figures: dict[str, Any] = {"tier": tier, "vertices": len(model.vertices)}
    begin = time.perf_counter()
    try:
        if tier == "surface":
            body: TissueBackend = WinklerTissue(model, Stiffness())
        else:
            body = ElasticTissue(model, _uniform(model), Stiffness())
    except (SizeError, StabilityError) as error:
        return {**figures, "refused": str(error)}
    figures["load_s"] = time.perf_counter() - begin
    figures["substeps"] = getattr(body, "substeps", 1)
    x = -SPEED_MPS * 5e-4 * steps + SPEED_MPS * 1e-3 * np.arange(steps)
    path = np.column_stack((x, np.full(steps, 0.001), np.full(steps, RADIUS_M - DEPTH_M)))
    return {**figures, **_slide(body, path, 1e-3)}


def _uniform(model: PhantomModel) -> Compliance:
    """A layer of 0.2 m: the step's cost does not depend on what is in the matrix."""
    return compliance(model, thickness_m=0.2)


def main() -> None:
    """Prints figures as JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sizes", action="store_true", help="cost against the number of vertices, both tiers")
    if parser.parse_args().sizes:
        for size in SIZES:
            for tier in ("surface", "elastic"):
                print(json.dumps(measure_size(size, tier)), flush=True)
    else:
        print(json.dumps(measure(), indent=2))


if __name__ == "__main__":
    main()
