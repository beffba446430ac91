"""Bodies from grid files."""

from pathlib import Path

import numpy as np
import pytest

from palpate_models.patient.grid import BodyGrid, read_grid
from palpate_models.patient.mesh_file import MeshError
from palpate_models.patient.phantom import build_phantom
from palpate_models.patient.schema import Phantom
from palpate_models.scenario.load import load_scenario


def _grid() -> BodyGrid:
    x, y = (a.ravel() for a in np.meshgrid(np.linspace(-0.03, 0.03, 13), np.linspace(-0.02, 0.02, 9), indexing="ij"))
    return BodyGrid(x, y, -2.0 * y**2, np.where(x > 0, 4e5, 2e5), np.where(x > 0, 4e4, 1e4), 100 + 1e3 * y)


def test_model_has_surface_and_mechanics_of_the_file(tmp_path: Path) -> None:
    _grid().write(tmp_path / "body.csv")
    (tmp_path / "twin.yaml").write_text("phantom: {kind: grid, grid: body.csv, edge_m: 0.0025}")
    model = build_phantom(load_scenario(str(tmp_path / "twin.yaml")).phantom, 0)
    assert np.abs(model.vertices[:, :2]).max() > 0.1
    inside = (np.abs(model.vertices[:, 0]) < 0.0275) & (np.abs(model.vertices[:, 1]) < 0.018)
    assert model.fixed.any()
    assert not model.fixed[inside].any()
    x, y, z = model.vertices[inside].T
    np.testing.assert_allclose(z, -2.0 * y**2, atol=3e-5)
    assert (model.normals[inside, 2] > 0.9).all()
    away = np.abs(x) > 0.006
    np.testing.assert_allclose(model.stiffness[inside][away], np.where(x > 0, 4e5, 2e5)[away])
    assert model.young is not None
    np.testing.assert_allclose(model.young[inside][away], np.where(x > 0, 4e4, 1e4)[away])
    np.testing.assert_allclose(model.stiffening[inside], 100 + 1e3 * y)


def _spoiled(lines: list[str], how: str) -> list[str]:
    row = lines[5].split(",")
    changed = {
        "units": [lines[0].replace("x_m", "x_mm"), *lines[1:]],
        "gap": lines[:5] + lines[6:],
        "twice": [*lines, lines[5]],
        "nan": [*lines[:5], ",".join([*row[:3], "nan", *row[4:]]), *lines[6:]],
        "soft": [*lines[:5], ",".join([*row[:3], "1", *row[4:]]), *lines[6:]],
        "moved": [*lines[:5], ",".join([row[0], "0.0013", *row[2:]]), *lines[6:]],
    }
    return changed[how]


@pytest.mark.parametrize(
    ("how", "named"),
    [
        ("units", "x_mm"),
        ("gap", "116 rows"),
        ("twice", "118 rows"),
        ("nan", "k_w_n_per_m3 = nan"),
        ("soft", "k_w_n_per_m3 = 1.0"),
        ("moved", "y_m"),
    ],
)
def test_unusable_file_is_refused_and_named(tmp_path: Path, how: str, named: str) -> None:
    path = tmp_path / "body.csv"
    _grid().write(path)
    path.write_text("\n".join(_spoiled(path.read_text().split(), how)))
    with pytest.raises(MeshError, match=named) as refused:
        read_grid(path)
    assert str(path) in str(refused.value)


def test_grid_needs_its_kind() -> None:
    with pytest.raises(ValueError, match="needs kind: grid"):
        Phantom(kind="parametric", grid="body.csv")
