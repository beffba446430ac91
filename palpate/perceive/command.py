"""`palpate perceive`."""

from pathlib import Path
from typing import Annotated

import typer

from palpate.console import output_folder
from palpate.run.options import Settings


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
    from dataclasses import asdict

    from palpate.console import print_json
    from palpate.perceive.perceive import perceived, write
    from palpate_bus.recordings import open_recording
    from palpate_camera.backends.replay import ReplayedCamera
    from palpate_models.scenario.load import load_scenario

    own = bag / "exam.yaml"
    chosen = load_scenario(scenario or (str(own) if own.is_file() else "clean"), settings or ())
    seen = perceived(ReplayedCamera(open_recording(bag), whole=False), chosen)
    figures = asdict(write(out, seen, chosen))
    if as_json:
        print_json(figures)
    else:
        print(", ".join(f"{name} {value:.4g}" for name, value in figures.items()))
        print(f"written to {out}: surface.ply, surface.png")
