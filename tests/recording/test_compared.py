"""Comparison of two palpations of one body, of outcomes, and a twin fitted to presses."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from palpate.comparison.compare import ComparedPalpation, compare, draw, read_outcomes, sim_to_real
from palpate.recording.recording import Contact, ContactKind, PalpationRecording
from palpate.report.scoring import Map
from palpate.twin.fit import presses_of, simulate, write_twin
from palpate_errors import UserError
from palpate_models.numerics.frames import Array, matrix
from palpate_models.patient.phantom import build_phantom, flat_phantom
from palpate_models.patient.schema import Lesion, Stiffness
from palpate_models.scenario.load import load_scenario
from palpate_models.section import Pose


def _body(xy: Array) -> tuple[Array, Array]:
    """Return height [m] and force [N] of a domed body with a stiff ridge."""
    x, y = xy.T
    return -4.0 * (x**2 + 2 * y**2), 2.0 + 2.0 * np.exp(-((y - 0.004) ** 2 + (0.3 * x) ** 2) / 5e-5) + 10 * x


def _palpated(name: str, scale: float, sd: float, seed: int, centre: tuple[float, float] = (0.0, 0.0)) -> ComparedPalpation:
    axis = np.arange(-0.03, 0.0301, 0.002)
    xy = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2) + centre
    height, force = _body(xy)
    rng = np.random.default_rng(seed)
    apparent = scale * force * np.exp(sd * rng.standard_normal(len(xy)))
    band = np.exp(1.645 * sd)
    finding = np.where(force - 10 * xy[:, 0] > 3.0, 0, -1).astype(np.int32)
    found = Map(np.column_stack((xy, height)), apparent, apparent / band, apparent * band, np.ones(len(xy), bool), finding)
    places = rng.uniform(-0.025, 0.025, (300, 2))
    height, force = _body(places)
    return ComparedPalpation(name, found, 0.01, np.column_stack((places, height)), scale * force)


def test_same_body_agrees_within_its_band(tmp_path: Path) -> None:
    compared = compare(_palpated("a", 1.0, 0.03, 0), _palpated("b", 1.5, 0.0, 1))
    found = compared.figures
    assert not found.registered
    assert found.level == pytest.approx(1.5, rel=0.02)
    assert found.bias == pytest.approx(np.log(1.5), abs=0.01)
    assert found.rank_correlation > 0.95
    assert found.inside_band == 0.0
    assert 0.85 < found.force_inside_band_90[0] < found.force_inside_band < found.force_inside_band_90[1]
    assert found.dice == pytest.approx(1.0)
    draw(tmp_path / "compare.png", compared)
    assert (tmp_path / "compare.png").stat().st_size > 10_000


def test_moved_body_is_registered() -> None:
    X = matrix(Pose(xyz_m=(0.02, -0.01, 0.3), rpy_rad=(0.05, -0.03, 0.2)))
    a, b = _palpated("a", 1.0, 0.02, 0), _palpated("b", 1.0, 0.0, 1).in_frame(X)
    found = compare(a, b).figures
    assert found.registered
    apart = np.array(found.X_AB) @ X - np.eye(4)
    assert np.abs(apart[:3, 3]).max() < 2e-3
    assert np.abs(apart[:3, :3]).max() < 0.06
    assert found.dice is not None
    assert found.dice > 0.8
    assert found.rank_correlation > 0.9


@pytest.mark.parametrize("centre", [(0.01, 0.0), (0.007, -0.007)])
def test_a_stiffer_map_of_a_region_10_mm_aside_is_registered_where_they_overlap(centre: tuple[float, float]) -> None:
    found = compare(_palpated("a", 1.0, 0.02, 0), _palpated("b", 1.2, 0.0, 1, centre), register=True).figures
    assert np.linalg.norm((np.array(found.X_AB) @ (*centre, 0.0, 1.0))[:3] - (*centre, 0.0)) < 2e-3
    assert found.level == pytest.approx(1.2, rel=0.02)


def test_bodies_without_common_places_are_refused() -> None:
    far = _palpated("b", 1.0, 0.0, 1).in_frame(matrix(Pose(xyz_m=(0.5, 0.0, 0.0))))
    with pytest.raises(UserError, match="0 places"):
        compare(_palpated("a", 1.0, 0.02, 0), far, register=False)


def test_simulation_narrows_the_interval_of_outcomes(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    true = rng.normal(size=220)
    rows = [f"{k},{true[k] + 0.2 * rng.normal() if k < 20 else ''},{true[k]}" for k in range(220)]
    path = tmp_path / "outcomes.csv"
    path.write_text("\n".join(("body,real,simulated", *rows)))
    found = sim_to_real(*read_outcomes(path))
    assert (found.pairs, found.simulated_only) == (20, 200)
    assert found.pearson > 0.9
    assert np.diff(found.prediction_powered_90) < 0.7 * np.diff(found.mean_90)


def test_outcomes_that_are_all_equal_have_no_correlation() -> None:
    assert sim_to_real(np.ones(4), np.ones(4), np.ones(2)).pearson is None


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("body,real\na,1", "simulated"),
        ("body,real,simulated\na,x,1\nb,2,2", "'x'"),
        ("body,real,simulated\na,,1\nb,2,2", "1 bodies"),
    ],
)
def test_unusable_outcomes_are_named(tmp_path: Path, text: str, named: str) -> None:
    path = tmp_path / "outcomes.csv"
    path.write_text(text)
    with pytest.raises(UserError, match=named):
        read_outcomes(path)


RADIUS_M = 0.0063
RIDGE = Lesion(centre_m=(0.1, 0.203), radii_m=(0.03, 0.003), contrast=3.0, edge_m=0.003)


def _map() -> Map:
    """Return a map with one finding, where the ridge is."""
    x, y = (a.ravel() for a in np.meshgrid(np.arange(0.085, 0.116, 0.001), np.arange(0.185, 0.216, 0.001)))
    force, finding = np.ones(len(x)), np.where(np.abs(y - 0.203) < 0.003, 0, -1).astype(np.int32)
    return Map(np.column_stack((x, y, -0.3 * force)), force, force, force, force > 0, finding)


@pytest.fixture(scope="module")
def recording() -> PalpationRecording:
    """Return probes to 3 mm of a flat body with a stiff ridge, 0.2 m from the origin of their frame."""
    axis = np.linspace(-0.014, 0.014, 8)
    xy = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    places, normals = np.column_stack((xy, np.zeros(64))), np.tile((0.0, 0.0, 1.0), (64, 1))
    depth = np.linspace(0.0004, 0.003, 8)
    origin = np.array((0.1, 0.2, -0.3))

    def contact(place: Array, force: Array) -> Contact:
        return Contact(ContactKind.PROBE, np.tile(place, (8, 1)), np.tile(normals[0], (8, 1)), depth, force, 1e-4, 0.01)

    blank = PalpationRecording("body", RADIUS_M, tuple(contact(place, np.ones(8)) for place in places), places, normals)
    ridge = RIDGE.model_copy(update={"centre_m": (0.0, 0.003)})
    body = flat_phantom(0.035, 0.0015, 8e5, [ridge])
    material = Stiffness(length_m=0.004, prony_g=(), prony_tau_s=())
    forces = simulate(body, material, presses_of(blank), (places, normals), RADIUS_M)
    noise = 0.01 * np.random.default_rng(0).standard_normal((64, 8))
    touches = tuple(contact(place + origin, force + e) for place, force, e in zip(places, forces, noise, strict=True))
    return PalpationRecording("body", RADIUS_M, touches, places + origin, normals)


def test_twin_reproduces_held_out_forces_and_has_the_lump(recording: PalpationRecording, tmp_path: Path) -> None:
    quality = write_twin(recording, tmp_path, _map())
    assert quality.variation > 0.15
    assert quality.error_at_depth < 0.08
    assert quality.error < 0.1
    assert quality.origin_m == pytest.approx((0.1, 0.2, -0.3))
    scenario = load_scenario(str(tmp_path / "twin.yaml"))
    (lump,) = scenario.phantom.lesions
    assert lump.contrast > 1.3
    model = build_phantom(scenario.phantom, 0)
    on_ridge = (model.lesion == 0) & (np.abs(model.vertices[:, 0]) < 0.01)
    assert np.median(model.stiffness[on_ridge]) > 1.3 * np.median(model.background[on_ridge])
    assert (tmp_path / "twin.png").stat().st_size > 10_000


def test_too_few_presses_are_refused(recording: PalpationRecording, tmp_path: Path) -> None:
    few = PalpationRecording("body", RADIUS_M, recording.touches[:5], recording.surface, recording.normals)
    with pytest.raises(UserError, match="5 presses"):
        write_twin(few, tmp_path)
    with pytest.raises(UserError, match="no contact"):
        write_twin(replace(few, touches=()), tmp_path)
