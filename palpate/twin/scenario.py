"""The twin as a scenario: twin.yaml, the grid file twin.csv, and how well it reproduces the recording."""

from dataclasses import replace
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import yaml
from matplotlib.figure import Figure
from numpy.typing import NDArray

from palpate.recording.recording import PalpationRecording
from palpate.report.files import write_text
from palpate.report.scoring import Map
from palpate.twin.fit import FittedWall, fit_wall, simulate, skin_at
from palpate_errors import UserError
from palpate_models.numerics.frames import Array, Mask
from palpate_models.patient.field import lesion_field
from palpate_models.patient.phantom import build_phantom
from palpate_models.patient.schema import Lesion
from palpate_models.scenario.load import load_scenario
from palpate_models.scenario.schema import Scenario
from palpate_tissue.backends.elastic.compliance import YOUNG_OVER_K_W
from palpate_tissue.backends.elastic.service import create as elastic_service
from palpate_tissue.service import TissueService

GRID: Final = "twin.csv"


class TwinTuning(NamedTuple):
    """Presses of the elastic twin, and findings that become lumps."""

    presses: int = 20
    """Presses from which the scale of Young's modulus is found."""
    steps: int = 8
    """Time steps of such a press: it goes down during the first half."""
    min_radius_m: float = 0.002
    """Minimum radius of a lump."""
    ring: float = 2.0
    """The surroundings of a finding reach this many of its radii."""
    min_contrast: float = 1.05
    """Minimum change of the modulus, up or down."""


TUNING: Final = TwinTuning()


class Quality(NamedTuple):
    """Simulated against recorded forces of a twin."""

    presses: int
    held_out: int
    error: float
    """RMS of the differences at the held-out places over the RMS of their forces, all readings."""
    error_at_depth: float
    """RMS of the differences at the maximum depth, over the RMS of their forces."""
    variation: float
    """SD over mean of the recorded forces at the maximum depth: the error of a twin that is the same everywhere."""
    onset_m: float
    lumps: int
    origin_m: tuple[float, float, float]
    """Origin of the twin's frame in the body frame of the recording [m]."""


def centre_on_skin(recording: PalpationRecording) -> tuple[PalpationRecording, Array]:
    """Return the recording with the origin on the skin in the middle of the contacts, and that origin [m], shape (3,).

    Raises UserError without contacts.
    """
    if not recording.touches:
        raise UserError(f"{recording.name}: no contact of which a twin can be made")
    places = np.array([touch.position.mean(axis=0) for touch in recording.touches])
    middle = (places.min(axis=0) + places.max(axis=0)) / 2
    origin = np.append(middle[:2], places[np.argmin(np.linalg.norm((places - middle)[:, :2], axis=1)), 2]).round(3)
    touches = tuple(replace(touch, position=touch.position - origin) for touch in recording.touches)
    return replace(recording, touches=touches, surface=recording.surface - origin), origin


def write_twin(
    recording: PalpationRecording, folder: Path, found: Map | None = None, elastic: bool = False, thickness_m: float = 0.05
) -> Quality:
    """Fit a twin to a recording, whose findings become its lumps, and write it into a folder. Raises UserError."""
    own, origin = centre_on_skin(recording)
    grid_file, file = folder / GRID, folder / "twin.yaml"
    wall = fit_wall(own, grid_file)
    lesions = [] if found is None else _lumps(found.vertices - origin, found.finding, wall)
    nodes = np.column_stack((wall.grid.x_m, wall.grid.y_m))
    healthy = wall.grid.k_w_n_per_m3 / lesion_field(nodes, lesions)[0]
    grid = replace(wall.grid, k_w_n_per_m3=healthy, young_pa=YOUNG_OVER_K_W * healthy)
    grid.write(grid_file)
    write_text(file, yaml.safe_dump(_scenario(own, wall, lesions, thickness_m, elastic), sort_keys=False))
    if elastic:
        felt, expected = _elastic(load_scenario(str(file)), wall, own.indenter_radius_m)
        replace(grid, young_pa=grid.young_pa * float(np.median(felt / expected))).write(grid_file)
    return _compare(load_scenario(str(file)), wall, own, folder, origin)


def _lumps(vertices: Array, finding: NDArray[np.int32], wall: FittedWall) -> list[Lesion]:
    """Return the findings of a map as ellipses, with the contrast that the fitted modulus has there."""
    lumps = []
    nodes = np.column_stack((wall.grid.x_m, wall.grid.y_m))
    for index in range(int(finding.max(initial=-1)) + 1):
        inside = vertices[finding == index, :2]
        if not len(inside):
            continue
        x, y = inside.mean(axis=0).tolist()
        a, b = np.maximum(2 * inside.std(axis=0), TUNING.min_radius_m).tolist()  # of a uniform ellipse
        away = np.linalg.norm((nodes - (x, y)) / (a, b), axis=1)
        k_w = wall.grid.k_w_n_per_m3
        ring = (away > 1) & (away <= TUNING.ring)
        if not ring.any():
            continue
        contrast = float(np.clip(np.median(k_w[away <= 1]) / np.median(k_w[ring]), 0.1, 20))
        if max(contrast, 1 / contrast) >= TUNING.min_contrast:
            lumps.append(Lesion(centre_m=(x, y), radii_m=(a, b), contrast=contrast, edge_m=min(0.008, a, b)))
    return lumps


def _scenario(
    recording: PalpationRecording, wall: FittedWall, lesions: list[Lesion], thickness_m: float, elastic: bool
) -> dict[str, Any]:
    """Return the fields of the scenario: the twin at rest, examined where and as deep as it was recorded."""
    places = np.array([press.place[:2] for press in wall.presses])
    low, high = places.min(axis=0), places.max(axis=0)
    size, radius = high - low, recording.indenter_radius_m
    stiffness = wall.stiffness.model_dump(mode="json", exclude={"k_w_n_per_m3", "stiffening_per_m"})
    return {
        "description": f"Twin fitted to {recording.name}",
        "phantom": {
            "kind": "grid",
            "grid": GRID,
            "size_m": [*np.ptp(np.column_stack((wall.grid.x_m, wall.grid.y_m)), axis=0).tolist(), thickness_m],
            "edge_m": wall.edge_m,
            "stiffness": stiffness,
            "lesions": [lesion.model_dump(mode="json") for lesion in lesions],
            "breathing": {"kind": "none"},
        },
        "exam": {
            "depth_m": float(np.clip(recording.depth_m, 0.002, 0.02)),
            "spacing_m": float(np.clip(0.8 * radius, 0.004, 0.0125)),
            "region_m": size.tolist(),
            "centre_m": ((low + high) / 2).tolist(),
        },
        "robot": {"indenter_radius_m": max(radius, 0.005)},
        "services": {"tissue": "elastic" if elastic else "winkler"},
    }


def _elastic(scenario: Scenario, wall: FittedWall, radius: float) -> tuple[Array, Array]:
    """Return recorded forces at the maximum depth of some presses, and those of the elastic tier [N], shapes (n,)."""
    service = elastic_service(scenario)
    assert isinstance(service, TissueService)
    fitted = np.flatnonzero(~wall.held_out)
    presses = [wall.presses[k] for k in fitted[:: max(1, len(fitted) // TUNING.presses)]]
    step = float(np.median([press.time[-1] for press in presses])) / TUNING.steps
    tissue = service.backend.in_steps_of(step)
    expected = []
    for press, place, normal in zip(presses, *skin_at(tissue.model, presses), strict=True):
        tissue.settle()
        depth = press.depth.max() + wall.onset_m
        for k in range(1, TUNING.steps + 1):
            centre = place + (radius - depth * min(1.0, 2 * k / TUNING.steps)) * normal
            force, _ = tissue.step(k * step, centre, np.zeros(3), radius)
        expected.append(float(force @ normal))
    return np.array([press.felt for press in presses]), np.array(expected)


def _compare(scenario: Scenario, wall: FittedWall, recording: PalpationRecording, folder: Path, origin: Array) -> Quality:
    """Press the written twin as the recording was, and draw both."""
    model = build_phantom(scenario.phantom, scenario.seed)
    at = skin_at(model, wall.presses)
    forces = simulate(model, scenario.phantom.stiffness, wall.presses, at, recording.indenter_radius_m, wall.onset_m)
    felt = np.array([press.felt for press in wall.presses])
    expected = np.array([force[press.deepest] for press, force in zip(wall.presses, forces, strict=True)])

    recorded = np.concatenate([press.force for press, out in zip(wall.presses, wall.held_out, strict=True) if out])
    twin = np.concatenate([force for force, out in zip(forces, wall.held_out, strict=True) if out])
    there = np.isfinite(recorded)
    _draw(folder / "twin.png", at[0], felt, expected, wall.held_out)
    x, y, z = origin.tolist()
    return Quality(
        presses=len(felt),
        held_out=int(wall.held_out.sum()),
        error=_relative(recorded[there], twin[there]),
        error_at_depth=_relative(felt[wall.held_out], expected[wall.held_out]),
        variation=float(felt.std() / felt.mean()),
        onset_m=wall.onset_m,
        lumps=len(scenario.phantom.lesions),
        origin_m=(x, y, z),
    )


def _relative(recorded: Array, twin: Array) -> float:
    return float(np.sqrt(np.mean((twin - recorded) ** 2) / np.mean(recorded**2)))


def _draw(path: Path, places: Array, felt: Array, expected: Array, held_out: Mask) -> None:
    """Draw recorded and simulated forces side by side, and against each other."""
    figure = Figure(figsize=(14, 4.2), layout="constrained")
    maps = figure.subplots(1, 3)
    low, high = np.quantile(felt, (0.01, 0.99))
    for axes, force, title in ((maps[0], felt, "recorded"), (maps[1], expected, "twin")):
        dots = axes.scatter(*(1e3 * places[:, :2].T), c=force, s=14, vmin=low, vmax=high)
        axes.set(title=f"{title}: force at the maximum depth [N]", xlabel="x [mm]", ylabel="y [mm]", aspect="equal")
        figure.colorbar(dots, ax=axes, shrink=0.8)
    for chosen, label in ((~held_out, "fitted"), (held_out, "held out")):
        maps[2].plot(felt[chosen], expected[chosen], ".", label=label)
    ends = (0.0, float(max(felt.max(), expected.max())))
    maps[2].plot(ends, ends, color="grey", lw=0.8)
    maps[2].set(title="twin against recording", xlabel="recorded [N]", ylabel="twin [N]", aspect="equal")
    maps[2].legend()
    figure.savefig(path, dpi=110)
