"""Error of the perceived surface before and after correction by images and touches: against the truth.

Run: `python -m research.skin FOLDER [--picture FILE.png]`, FOLDER that of a `palpate run --record normal`.
"""

import argparse
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from palpate.truth.pressed import TrueBody, TrueSurface
from palpate_bus.contract import contract
from palpate_bus.messages import codec
from palpate_bus.messages.codec import Message
from palpate_bus.recordings import open_recording
from palpate_models.numerics.frames import Array, apply, inverse, matrix
from palpate_models.patient.phantom import build_phantom
from palpate_models.scenario.load import exam_input, load_scenario, true_pose
from palpate_models.scenario.schema import Scenario
from palpate_validation.check import write_figure

SURFACE, IMAGES, ALL = "perception/surface", "perception/correction", "exam/correction"


@dataclass(frozen=True)
class SkinError:
    """Outward offset of the skin from the perceived surface at n places of the region, without offset and tilt [m]."""

    xy: Array
    """In A, shape (n, 2)."""
    true: Array
    """In truth, at the end of expiration, shape (n,)."""
    images: Array
    """By the mean of all small images."""
    known: Array
    """Estimate from images and touches, as used by the assessment."""
    reported: Array
    """Reported standard deviation of `known`."""


def read(folder: Path) -> SkinError:
    """Return the skin of a recorded run. Raises RecordingError, and KeyError where no correction was sent."""
    scenario, newest = load_scenario(str(folder / "scenario.yaml")), dict[str, Message]()
    for message in open_recording(folder).messages((SURFACE, IMAGES, ALL)):
        newest[message.topic] = codec.decode(message.payload, contract().topics[message.topic].type)
    p_W, n_W = (np.asarray(x, float).reshape(-1, 3) for x in (newest[SURFACE].vertices, newest[SURFACE].normals))
    p_A = apply(inverse(np.array(exam_input(scenario).X_WA)), p_W)
    half = 0.5 * np.array(scenario.exam.region_m)
    inside = (np.abs(p_A[:, :2] - scenario.exam.centre_m) <= half).all(axis=1)
    true, lifts = outward(scenario, p_W, n_W)
    flat = np.column_stack((np.ones(len(p_A)), p_A[:, :2], lifts))[inside]  # well determined by touches

    def bent(values: Array) -> Array:
        inner = np.asarray(values, float)[inside]
        return np.asarray(inner - flat @ np.linalg.lstsq(flat, inner, rcond=None)[0])

    reported = np.asarray(newest[ALL].uncertainty, float)[inside]
    return SkinError(p_A[inside, :2], bent(true), bent(newest[IMAGES].outward), bent(newest[ALL].outward), reported)


def outward(scenario: Scenario, p_W: Array, n_W: Array) -> tuple[Array, Array]:
    """Return the outward offset of the true skin at the end of expiration [m] and its breathing amplitude, (n,) each."""
    X_WA = matrix(true_pose(scenario))
    model = build_phantom(scenario.phantom, scenario.seed)
    skin = TrueSurface(TrueBody(model.vertices, model.triangles, X_WA))
    p_A, n_A = apply(inverse(X_WA), p_W), n_W @ X_WA[:3, :3]
    return (skin.height(p_A[:, :2]) - p_A[:, 2]) * n_A[:, 2], np.asarray(skin.between(model.breathing)(p_A[:, :2]))


def draw(figure: Figure, skin: SkinError) -> None:
    """The true error of the surface, what is known of it, and what is left, as maps."""
    panels = figure.subplots(1, 3, sharex=True, sharey=True)
    parts = (("error of the surface", skin.true), ("as it is known", skin.known), ("what is left", skin.true - skin.known))
    for panel, (name, values) in zip(panels, parts, strict=True):
        x, y = 1e3 * skin.xy.T
        drawn = panel.tricontourf(x, y, 1e3 * values, levels=np.linspace(-1.2, 1.2, 25), cmap="RdBu_r", extend="both")
        panel.set_title(f"{name}: {1e3 * values.std():.2f} mm", loc="left")
        panel.set_aspect("equal")
        panel.set_xlabel("x [mm]")
    panels[0].set_ylabel("y [mm]")
    figure.colorbar(drawn, ax=panels, label="outward [mm]", shrink=0.8)


def main() -> None:
    """Print how large each part is, and draw the maps."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--picture", type=Path)
    args = parser.parse_args()
    skin = read(args.folder)
    left = {"images": skin.true - skin.images, "images and touches": skin.true - skin.known}
    print(f"{args.folder}: error of the surface without offset and tilt {1e3 * skin.true.std():.2f} mm")
    for name, values in left.items():
        print(f"remaining after {name}: {1e3 * values.std():.2f} mm")
    print(f"reported standard deviation {1e3 * np.sqrt(np.mean(skin.reported**2)):.2f} mm")
    if args.picture is not None:
        write_figure(lambda figure: draw(figure, skin), args.picture, size_in=(9.0, 3.2))


if __name__ == "__main__":
    main()
