"""DART's soft bodies and MuJoCo's flex against our tissue: every bound; costs are printed, not tested. Micro-benchmarks run."""

import importlib.util
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from palpate_benchmarks.bench import codec_cost, tables, tissue_cost
from palpate_validation.check import PageSection
from palpate_validation.drop import Ellipsoid, Flesh, SoftBox
from research import dart_bodies, flex
from research.dart_bodies import box_surface, ellipsoid_edges, ellipsoid_surface, graph_laplacian, twin


def assert_bounds(section: PageSection) -> None:
    missed = [f"{c.name}: {c.measured} {c.unit}, want {c.bound}" for c in section.checks if c.passed is False and not c.timed]
    assert not missed


SMALL = Flesh(SoftBox((0.06, 0.06, 0.03), (13, 13, 3)), k_v=4.25, k_e=0.0, damping=0.6, mass=0.02)
DEPTHS = np.array((0.004,))


def test_a_dart_box_that_sticks_gives_our_force() -> None:
    ours = dart_bodies.press_ours(SMALL, DEPTHS).force
    np.testing.assert_allclose(dart_bodies.press_dart(SMALL, 1.0, DEPTHS).force, ours, rtol=0.02)


def test_a_slippery_dart_box_gives_the_force_of_sliding_vertices() -> None:
    exact = dart_bodies.sliding_vertices(SMALL, DEPTHS)
    np.testing.assert_allclose(dart_bodies.press_dart(SMALL, 0.0, DEPTHS).force, exact, rtol=0.02)
    assert exact[0] < 0.9 * dart_bodies.press_ours(SMALL, DEPTHS).force[0]


@pytest.mark.slow
def test_dart_bodies() -> None:
    assert_bounds(dart_bodies.section())


def test_twins_have_darts_vertices() -> None:
    box, ellipsoid = SoftBox((0.1, 0.08, 0.05), (5, 6, 4)), Ellipsoid((0.3, 0.2, 0.1), 7, 9)
    for (points, normals), shape in ((box_surface(box), box), (ellipsoid_surface(ellipsoid), ellipsoid)):
        assert len(points) == len(normals) == shape.vertices
        assert len(np.unique(points.round(9), axis=0)) == shape.vertices
        np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1)
        assert points[:, 2].max() == pytest.approx(0)
    edges = ellipsoid_edges(ellipsoid)
    assert len(np.unique(np.sort(edges, axis=1), axis=0)) == len(edges)
    np.testing.assert_allclose(graph_laplacian(edges, ellipsoid.vertices).sum(axis=1), 0, atol=1e-12)


def test_a_twin_under_one_vertex_is_one_spring() -> None:
    """A tiny dent in a body without edges: only the middle vertex moves, with k_v."""
    flesh = Flesh(SoftBox((0.06, 0.06, 0.03), (13, 13, 3)), k_v=5.0, k_e=0.0, damping=0.5, mass=0.02)
    assert dart_bodies.press_ours(flesh, np.array((2e-4,))).force[0] == pytest.approx(5.0 * 2e-4, rel=1e-3)
    assert len(twin(flesh).model.vertices) == flesh.shape.vertices


def test_a_small_flex_pushes_back(tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    block = flex.FlexBlock((7, 7, 4), 0.015)
    force, cost = block.press(0.004)
    assert 0.2 < force < 5
    assert cost > 0
    assert not list(tmp_path.iterdir())  # MuJoCo would write its warnings to a file


@pytest.mark.slow
def test_mujoco_flex() -> None:
    assert_bounds(flex.section())


FOLDER = Path(__file__).parents[2] / "asv" / "benchmarks"


def benchmarks(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"asv_{name}", FOLDER / f"{name}.py")
    assert spec
    assert spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("by", ["palpate", "rosbags"])
def test_codec(by: str) -> None:
    codec = benchmarks("codec").Codec()
    codec.setup("joint_state", by)
    codec.time_encode()
    codec.time_decode()


@pytest.mark.parametrize("wall", ["linear", "guarding"])
def test_a_step_on_the_abdomen(wall: str) -> None:
    abdomen = benchmarks("tissue").Abdomen()
    abdomen.setup("surface", wall)
    abdomen.time_step()
    assert abdomen.track_contacts() > 5


@pytest.mark.parametrize("tier", ["surface", "elastic"])
def test_a_step_on_a_flat_patch(tier: str) -> None:
    patch = benchmarks("tissue").FlatPatch()
    patch.setup(tier, 700)
    patch.time_step()
    assert len(patch.body.contacts) > 3


def test_a_size_that_the_tier_refuses_is_skipped(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("palpate_tissue.backends.elastic.compliance.MOST_VERTICES", 500)
    with pytest.raises(NotImplementedError):
        benchmarks("tissue").FlatPatch().setup("elastic", 700)


def test_the_parts_of_bench() -> None:
    figures = {"runs": {}, "parts": {"codec": codec_cost(20), "tissue": tissue_cost("surface", 50)}}
    assert all(value > 0 for part in figures["parts"].values() for value in part.values())
    assert [table.title for table in tables(figures)] == ["Parts"]
