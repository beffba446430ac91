"""Surface error against the true phantom for seeds, camera poses, frames and noise; the README's table.

Run: `python services/perception/tests/bench_perception_surface.py [PNG]`
"""

import sys
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from test_perception_service import look, phantom, rms, scenario, surface_error, vertices

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


def picture(sent: dict[str, Any], error: np.ndarray, path: str) -> None:
    """Error over the region, next to the perceived height."""
    true = phantom().vertices[phantom().normals[:, 2] > 0.3]
    true = true[(np.abs(true[:, :2]) <= 0.1).all(axis=1)]
    figure, (left, right) = plt.subplots(1, 2, figsize=(12, 5), layout="constrained")
    p = 1e3 * (vertices(sent["perception/surface"]) - (0.56, 0.0, 0.93))
    for axes, xyv, label in ((left, p, "perceived height [mm]"), (right, np.c_[1e3 * true[:, :2], error], "error [mm]")):
        limit = {"vmin": -0.3, "vmax": 0.3, "cmap": "RdBu_r"} if axes is right else {}
        figure.colorbar(axes.tripcolor(*xyv.T, shading="gouraud", **limit), ax=axes, label=label)
        axes.set(aspect="equal", xlabel="x_A [mm]", ylabel="y_A [mm]")
    figure.savefig(path, dpi=80)


def main() -> None:
    print("| case (3 seeds) | RMS [mm] | largest [mm] | bias [mm] | own estimate [mm] |\n|---|---|---|---|---|")
    for name, (settings, frames) in CASES.items():
        looks = [look(scenario(*settings, seed=seed), frames) for seed in range(3)]
        errors = [1e3 * surface_error(scenario(*settings), sent) for sent in looks]
        own = np.mean([1e3 * sent["perception/targets"].surface_noise for sent in looks])
        worst = max(np.abs(error).max() for error in errors)
        print(f"| {name} | {rms(np.array(errors)):.3f} | {worst:.2f} | {np.mean(errors):+.3f} | {own:.3f} |", flush=True)
        if name == "default" and len(sys.argv) > 1:
            picture(looks[0], errors[0], sys.argv[1])


if __name__ == "__main__":
    main()
