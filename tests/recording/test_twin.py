"""A twin fitted to presses of a simulated body."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from palpate.recording.recording import Contact, ContactKind, PalpationRecording
from palpate.report.scoring import Map
from palpate.twin.fit import presses_of, simulate, write_twin
from palpate_errors import UserError
from palpate_models.numerics.frames import Array
from palpate_models.patient.phantom import build_phantom, flat_phantom
from palpate_models.patient.schema import Lesion, Stiffness
from palpate_models.scenario.load import load_scenario

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
