"""Error of the perceived surface against the true phantom for seeds, camera poses, frames and noise; no other service.

Run: `python -m research.perceived_surface`; prints the README's table.
"""

from functools import cache
from typing import Any

import numpy as np
from scipy.interpolate import LinearNDInterpolator

from palpate_bus.messages import MS, CameraTrigger, header
from palpate_bus.messages.geometry import mesh_message
from palpate_bus.testing import HandInbox
from palpate_camera.backends.kinect.service import CameraService
from palpate_models.numerics.frames import Array, apply, inverse, matrix
from palpate_models.patient.phantom import PhantomModel, build_phantom
from palpate_models.scenario.load import load_scenario, plant_input, true_pose
from palpate_models.scenario.schema import Scenario
from palpate_perception.service import PerceptionService

TICK = 100 * MS
CASES: dict[str, tuple[tuple[str, ...], int]] = {
    "default": ((), 20),
    "5 frames": ((), 5),
    "1 frame": ((), 1),
    "noise x 2": (("errors.camera.noise_scale=2.0",), 20),
    "no noise": (("errors.camera.noise_scale=0.0",), 1),
    "from the feet": (("camera.position_m=[0.56, -0.6, 1.75]",), 20),
    "from the side, low": (("camera.position_m=[1.1, 0.0, 1.6]",), 20),
    "near": (("camera.position_m=[0.65, -0.35, 1.7]",), 20),
    "far (2.0 m)": (("camera.position_m=[1.2, -0.8, 2.6]",), 20),
    "region 0.3 x 0.3": (("exam.region_m=[0.3, 0.3]",), 20),
}


@cache
def phantom() -> PhantomModel:
    """Return the default phantom."""
    return build_phantom(Scenario().phantom, 0)


def scenario(*settings: str, seed: int = 0) -> Scenario:
    """Return the scenario `clean` with settings."""
    return load_scenario("clean", settings, seed)


def skin(case: Scenario, rise: float = 0.0) -> Any:
    """Return sim/surface of the phantom at rest, lifted by `rise` [m]."""
    p_W = apply(matrix(true_pose(case)), phantom().vertices) + np.array((0, 0, rise))
    return mesh_message(header(0, "world"), p_W, triangles=phantom().triangles)


def look(
    case: Scenario,
    frames: int | None = None,
    links: Any = None,
    rises: tuple[float, ...] = (0.0,),
    perception: PerceptionService | None = None,
) -> dict[str, Any]:
    """Return the messages of perception after a burst of the camera, by topic."""
    exam = plant_input(case)
    camera, perception = CameraService(exam), perception or PerceptionService(exam)
    seen = HandInbox().receive({"sim/link_poses": links} if links else {})
    inputs = HandInbox().receive(camera.start())
    trigger = {"planning/camera_trigger": CameraTrigger(header(5 * MS), frames or case.camera.frames)}
    images: dict[str, Any] = {}
    for k in range(1, 120):
        start = trigger if k == 1 else {}
        sent = perception.step(k * TICK, inputs.receive({**start, **images}))
        if "perception/targets" in sent:
            return dict(sent)
        images = dict(camera.step(k * TICK, seen.receive({"sim/surface": skin(case, rises[k % len(rises)]), **start})))
    raise AssertionError("perception published nothing")


def vertices(message: Any) -> Array:
    """Return the vertices of a mesh message, shape (n, 3)."""
    return np.asarray(message.vertices, np.float64).reshape(-1, 3)


def surface_error(case: Scenario, sent: dict[str, Any]) -> Array:
    """Return perceived minus true height along z_A [m] at the phantom's vertices in the region."""
    perceived = apply(inverse(matrix(true_pose(case))), vertices(sent["perception/surface"]))
    true = phantom().vertices[phantom().normals[:, 2] > 0.3]
    true = true[(np.abs(true[:, :2]) <= np.array(case.exam.region_m) / 2).all(axis=1)]
    return np.asarray(LinearNDInterpolator(perceived[:, :2], perceived[:, 2])(true[:, :2]) - true[:, 2])


def rms(values: Array) -> float:
    """Return the root of the mean square."""
    return float(np.sqrt(np.mean(values**2)))


def main() -> None:
    """Print the table."""
    print("| case (3 seeds) | RMS [mm] | largest [mm] | bias [mm] | own estimate [mm] |\n|---|---|---|---|---|")
    for name, (settings, frames) in CASES.items():
        looks = [look(scenario(*settings, seed=seed), frames) for seed in range(3)]
        errors = [1e3 * surface_error(scenario(*settings), sent) for sent in looks]
        own = np.mean([1e3 * sent["perception/targets"].surface_noise for sent in looks])
        worst = max(np.abs(error).max() for error in errors)
        print(f"| {name} | {rms(np.array(errors)):.3f} | {worst:.2f} | {np.mean(errors):+.3f} | {own:.3f} |", flush=True)


if __name__ == "__main__":
    main()
