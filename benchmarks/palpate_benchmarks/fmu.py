"""What a step of the FMU costs in process: through FMPy, and through prepared ctypes calls."""

from __future__ import annotations

import json
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from palpate_benchmarks.turns import compared, in_turns
from palpate_fmu.compiling import native
from palpate_fmu.export import build_fmu
from palpate_fmu.instance import FmuInstance
from palpate_models.numerics.frames import Array
from palpate_models.patient.phantom import PhantomModel, build_phantom
from palpate_models.patient.schema import Lesion, Phantom, Stiffness

RADIUS_M = 0.015
DEPTH_M = 0.010
SPEED_MPS = 0.03
STEP_S = 1e-3


def sliding_path(model: PhantomModel, steps: int) -> tuple[Array, Array]:
    """Position and velocity of a sphere that slides along x at 10 mm depth, (steps, 3) each, in A."""
    x = -0.06 + SPEED_MPS * STEP_S * np.arange(steps)
    front = np.flatnonzero(model.normals[:, 2] > 0.5)
    nearest = [front[np.hypot(model.vertices[front, 0] - at, model.vertices[front, 1] - 0.01).argmin()] for at in x[::100]]
    height = np.interp(x, x[::100], model.vertices[nearest, 2])
    position = np.column_stack((x, np.full(steps, 0.01), height + RADIUS_M - DEPTH_M))
    return position, np.tile((SPEED_MPS, 0.0, 0.0), (steps, 1))


def _time(step: Callable[[int], Any], steps: int) -> tuple[float, float]:
    costs = np.empty(steps)
    for k in range(steps):
        begin = time.perf_counter_ns()
        step(k)
        costs[k] = (time.perf_counter_ns() - begin) / 1e3
    return float(np.median(costs)), float(np.percentile(costs, 99))


def _by_fmpy(path: Path, position: Array, velocity: Array) -> tuple[float, float]:
    """Cost of a step by FMPy's own slave interface."""
    import fmpy  # noqa: PLC0415  (slow to import)
    from fmpy.simulation import instantiate_fmu  # noqa: PLC0415

    description = fmpy.read_model_description(str(path))
    with tempfile.TemporaryDirectory() as folder:
        fmpy.extract(str(path), unzipdir=folder)
        fmu = instantiate_fmu(folder, description, "CoSimulation")
        fmu.enterInitializationMode()
        fmu.exitInitializationMode()

        def step(k: int) -> None:
            fmu.setFloat64([1, 4], [*position[k], *velocity[k]])
            fmu.doStep(k * STEP_S, STEP_S)
            fmu.getFloat64([10, 13], 6)

        cost = _time(step, len(position))
        fmu.terminate()
        fmu.freeInstance()
    return cost


def _stepping(fmu: FmuInstance, position: Array, velocity: Array) -> Callable[[int], None]:
    """A step along the path by prepared ctypes calls."""
    motion = fmu.port(["indenter_position", "indenter_velocity"])
    wrench = fmu.port(["contact_force", "contact_torque"])

    def step(k: int) -> None:
        motion["indenter_position"][:] = position[k]
        motion["indenter_velocity"][:] = velocity[k]
        motion.push()
        fmu.step(k * STEP_S, STEP_S)
        wrench.pull()

    return step


def measure(steps: int = 3000) -> dict[str, float]:
    """Cost of a step [us] on the default abdomen with a lesion, sliding at 10 mm depth: median and 99th percentile.

    Each with setting the motion and reading the wrench: through FMPy's interface and through prepared ctypes calls (what the
    bus service uses); and the surface's displacement read once. The native tissue's cost is in its own benchmark. Last,
    processor time of one whose wall does not stiffen and of this one, stepped in turns, and their ratios.
    """
    phantom = Phantom(lesions=(Lesion(centre_m=(-0.055, 0.01)),))
    model = build_phantom(phantom, seed=0)
    position, velocity = sliding_path(model, steps)
    figures: dict[str, float] = {"vertices": len(model.vertices)}
    with tempfile.TemporaryDirectory() as folder:
        path = build_fmu(phantom, 0, Path(folder) / "abdomen.fmu", 3, [native()], RADIUS_M, model)
        figures["fmpy_us_p50"], figures["fmpy_us_p99"] = _by_fmpy(path, position, velocity)
        still = phantom.model_copy(update={"stiffness": Stiffness(stiffening_per_m=0.0)})
        linear_path = build_fmu(still, 0, Path(folder) / "linear.fmu", 3, [native()], RADIUS_M, build_phantom(still, seed=0))
        with FmuInstance(path) as fmu:
            figures["ctypes_us_p50"], figures["ctypes_us_p99"] = _time(_stepping(fmu, position, velocity), steps)
            surface = fmu.port(["surface_displacement"])
            figures["surface_us_p50"] = _time(lambda _: surface.pull(), 200)[0]
            figures["contacts"] = float(fmu.get("contacts"))
        with FmuInstance(linear_path) as linear, FmuInstance(path) as stiffening:
            ways = [_stepping(body, position, velocity) for body in (linear, stiffening)]
            figures |= compared(in_turns(ways, steps), ("linear", "stiffening"))
    return figures


if __name__ == "__main__":
    print(json.dumps(measure(), indent=2))
