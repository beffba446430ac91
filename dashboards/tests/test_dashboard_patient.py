"""The patient that is drawn about the abdomen: leaves a window, covers the rest, lies on the table, has its outside outside."""

from __future__ import annotations

import numpy as np
import pytest

from palpate_dashboard.patient import HANG_M, Bed, parts, window
from palpate_models.patient.phantom import build_phantom
from palpate_models.patient.schema import Phantom

BED = Bed(height=-0.20, half_width=0.275)
REGION, CENTRE = (0.20, 0.20), (0.0, 0.0)


@pytest.fixture(scope="module")
def surface() -> np.ndarray:
    return np.asarray(build_phantom(Phantom(edge_m=0.01), 0).vertices)


def test_the_window_shows_the_region_and_no_drape_lies_in_it(surface: np.ndarray) -> None:
    x0, x1, y0, y1 = window(surface, REGION, CENTRE)
    assert x0 < -0.1 < 0.1 < x1
    assert y0 < -0.1 < 0.1 < y1
    drape = next(part for part in parts(surface, BED, REGION, CENTRE) if part.name == "drape")
    centres = drape.vertices[drape.triangles].mean(axis=1)
    within = (centres[:, 0] > x0) & (centres[:, 0] < x1) & (centres[:, 1] > y0) & (centres[:, 1] < y1)
    assert not within.any()


def test_the_window_stays_on_the_abdomen(surface: np.ndarray) -> None:
    x0, x1, y0, y1 = window(surface, (0.5, 0.6), (0.02, 0.0))
    low, high = surface.min(axis=0), surface.max(axis=0)
    assert low[0] < x0 < x1 < high[0]
    assert low[1] < y0 < y1 < high[1]


def test_the_drape_covers_the_abdomen_beside_the_window(surface: np.ndarray) -> None:
    drape = next(part for part in parts(surface, BED, REGION, CENTRE) if part.name == "drape")
    x0, x1, y0, y1 = window(surface, REGION, CENTRE)
    for x, y, z in surface[surface[:, 2] > -0.03]:
        if not (x0 - 0.012 < x < x1 + 0.012 and y0 - 0.012 < y < y1 + 0.012):
            near = np.argmin(np.hypot(drape.vertices[:, 0] - x, drape.vertices[:, 1] - y))
            assert drape.vertices[near, 2] > z - 0.003, (x, y)


def test_it_lies_on_the_table_and_looks_out(surface: np.ndarray) -> None:
    for part in parts(surface, BED, REGION, CENTRE):
        assert part.vertices[:, 2].min() >= BED.height - HANG_M - 0.02, part.name
        assert np.linalg.norm(part.normals, axis=1) == pytest.approx(1.0, abs=1e-4)
        if part.name == "drape":
            flat = np.abs(part.vertices[:, 0]) < 0.25
            assert part.vertices[flat, 2].min() > BED.height
            assert part.normals[flat, 2].mean() > 0.6
        else:
            a, b, c = (part.vertices[part.triangles[:, i]].astype(float) for i in range(3))
            assert np.einsum("ij,ij->i", a, np.cross(b, c)).sum() > 0.006  # six times the volume [m^3], of closed surfaces
