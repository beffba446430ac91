"""`palpate perceive`: the perceived surface of a depth recording, by the perception pipeline on all its images."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from palpate.console import output_folder, print_json
from palpate.run.options import Settings
from palpate_errors import RunError

if TYPE_CHECKING:
    from palpate_camera.backends.replay import ReplayedCamera
    from palpate_models.numerics.frames import Array
    from palpate_models.scenario.schema import Scenario
    from palpate_perception.pipeline import Perceived


def perceive(
    bag: Annotated[Path, typer.Argument(metavar="BAG", help="Depth recording: rosbag2 folder, MCAP file or folder of a run.")],
    scenario: Annotated[
        str | None, typer.Option("--scenario", help="Place and size of the region; by default those of the run, or of `clean`.")
    ] = None,
    out: Annotated[Path, output_folder("Folder of surface.ply and surface.png.", "--out", "-o")] = Path("perceived"),
    settings: Settings = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the figures as JSON.")] = False,
) -> None:
    """Perceive a surface with its normals in a depth recording, without a run.

    The recording needs camera/depth/image_raw, camera/depth/camera_info and tf_static with the camera's pose in world.
    surface.ply is in the abdomen frame, so it can be a scenario's `phantom.mesh`.

    [bold]Examples[/]

      palpate perceive results/clean                          the scan of a run

      palpate perceive bag --set exam.region_m=[0.1,0.1]      a region of another size
    """
    from palpate_bus.recordings import open_recording
    from palpate_camera.backends.replay import ReplayedCamera
    from palpate_models.scenario.load import load_scenario

    own = bag / "exam.yaml"
    chosen = load_scenario(scenario or (str(own) if own.is_file() else "clean"), settings or ())
    seen = perceive_recording(ReplayedCamera(open_recording(bag), whole=False), chosen)
    figures = write(out, seen, chosen)
    if as_json:
        print_json(figures)
    else:
        print(", ".join(f"{name} {value:.4g}" for name, value in figures.items()))
        print(f"written to {out}: surface.ply, surface.png")


def perceive_recording(camera: ReplayedCamera, scenario: Scenario) -> Perceived:
    """Return the result of perception from all images of a recording. Raises RunError without a surface."""
    import numpy as np

    from palpate_models.scenario.load import exam_input
    from palpate_perception.cloud import Intrinsics
    from palpate_perception.pipeline import Pipeline

    pinhole = camera.frames[0].pinhole
    intrinsics = Intrinsics(pinhole.matrix, camera.X_WC, (pinhole.height, pinhole.width))
    pipeline = Pipeline(scenario.exam, np.array(exam_input(scenario).X_WA))
    fusion = pipeline.fusion(intrinsics)
    for frame in camera.frames:
        fusion.add(frame.depth)
    found = pipeline.perceive(fusion, intrinsics)
    if found.mesh is None:
        raise RunError(f"no surface: {found.message}")
    return found


def write(folder: Path, found: Perceived, scenario: Scenario) -> dict[str, float]:
    """Write surface.ply and surface.png, in the abdomen frame, and return figures of the surface.

    `coverage` is the share of the region that is in view, `noise_mm` the SD of the surface, `steepest_deg` the largest angle
    between a normal and z.
    """
    import numpy as np
    import trimesh

    from palpate_models.numerics.frames import apply, inverse
    from palpate_models.scenario.load import exam_input

    assert found.mesh is not None
    X_AW = inverse(np.array(exam_input(scenario).X_WA))
    vertices, normals = apply(X_AW, found.mesh.p_W), found.mesh.n_W @ X_AW[:3, :3].T
    mesh = trimesh.Trimesh(vertices, found.mesh.triangles.astype(np.int64), vertex_normals=normals, process=False)
    mesh.export(folder / "surface.ply", vertex_normal=True)
    _draw(folder / "surface.png", vertices, normals)
    steepest = float(np.degrees(np.arccos(np.clip(normals[:, 2].min(), -1, 1))))
    seen = {"frames": found.frames, "coverage": found.coverage, "noise_mm": 1e3 * found.sigma}
    return {**seen, "vertices": len(vertices), "area_cm2": 1e4 * float(mesh.area), "steepest_deg": steepest}


def _draw(path: Path, vertices: Array, normals: Array) -> None:
    """Draw heights and normals over the plane of the abdomen frame."""
    import numpy as np
    from matplotlib.figure import Figure

    x, y, z = 1e3 * vertices.T
    figure = Figure(figsize=(10.5, 4.6), layout="constrained")
    left, right = figure.subplots(1, 2)
    shown = left.tricontourf(x, y, z, 24)
    figure.colorbar(shown, ax=left, label="height [mm]")
    some = slice(None, None, max(1, len(x) // 500))
    left.quiver(x[some], y[some], *(normals[some, :2].T), angles="xy", width=0.002)
    shown = right.tricontourf(x, y, np.degrees(np.arccos(np.clip(normals[:, 2], -1, 1))), 24, cmap="magma")
    figure.colorbar(shown, ax=right, label="slope [deg]")
    for axes, title in ((left, "surface and normals"), (right, "slope")):
        axes.set(title=title, xlabel="x [mm], to the left", ylabel="y [mm], to the head", aspect="equal")
    figure.savefig(path, dpi=110)
