"""Steps 4 and 5: the lattice of palpation points and the order in which they are visited."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from palpate_models.scenario import Exam, Pattern
from palpate_perception import pattern

exams = st.builds(
    Exam,
    region_m=st.tuples(st.floats(0.03, 0.4), st.floats(0.03, 0.4)),
    centre_m=st.tuples(st.floats(-0.1, 0.1), st.floats(-0.1, 0.1)),
    spacing_m=st.floats(0.004, 0.05),
)


@settings(deadline=None)
@given(exams)
def test_the_lattice_covers_the_region_with_both_ends(exam: Exam) -> None:
    for axis, station in enumerate(pattern.lattice(exam)):
        centre, length = exam.centre_m[axis], exam.region_m[axis]
        np.testing.assert_allclose((station[0], station[-1]), (centre - length / 2, centre + length / 2), atol=1e-12)
        gaps = np.diff(station)
        assert (gaps > 0).all()
        assert (gaps <= exam.spacing_m * (1 + 1e-6)).all()
        np.testing.assert_allclose(gaps, gaps[0], rtol=1e-6)
        assert gaps[0] > exam.spacing_m / 2 - 1e-9  # no more lines than needed


def test_the_default_region_has_seventeen_lines_of_seventeen_points() -> None:
    x, y = pattern.lattice(Exam())
    assert (len(x), len(y)) == (17, 17)
    np.testing.assert_allclose(np.diff(x), 0.0125)


sizes = st.tuples(st.integers(1, 12), st.integers(2, 12))


@settings(deadline=None)
@given(sizes, st.sampled_from(Pattern))
def test_every_node_is_visited_once_line_by_line(size: tuple[int, int], kind: Pattern) -> None:
    sequence = pattern.order(*size, kind)
    assert sorted(sequence) == list(range(size[0] * size[1]))
    lines = sequence // size[1]
    assert (np.diff(lines) >= 0).all()
    assert lines[0] == 0


@settings(deadline=None)
@given(sizes)
def test_a_snake_alternates_and_never_jumps(size: tuple[int, int]) -> None:
    sequence = pattern.order(*size, Pattern.SNAKE)
    line, point = np.divmod(sequence, size[1])
    assert (np.abs(np.diff(line)) + np.abs(np.diff(point)) == 1).all()
    direction = np.diff(point.reshape(size), axis=1)
    assert (direction == np.where(np.arange(size[0]) % 2 == 0, 1, -1)[:, np.newaxis]).all()


@settings(deadline=None)
@given(sizes)
def test_a_raster_goes_the_same_way_on_every_line(size: tuple[int, int]) -> None:
    point = pattern.order(*size, Pattern.RASTER) % size[1]
    assert (np.diff(point.reshape(size), axis=1) == 1).all()


def test_down_sampling_gives_one_node_a_cell_and_says_which_have_no_points() -> None:
    x, y = np.linspace(-0.1, 0.1, 5), np.linspace(-0.05, 0.05, 3)
    rng = np.random.default_rng(0)
    p = np.column_stack((rng.uniform(-0.12, 0.12, 4000), rng.uniform(-0.08, 0.08, 4000), np.zeros(4000)))
    hole = np.hypot(p[:, 0] - 0.05, p[:, 1]) < 0.04
    nodes, known = pattern.downsample(p[~hole], x, y)
    assert nodes.shape == (15, 2)
    np.testing.assert_allclose(nodes[:3], [(-0.1, -0.05), (-0.1, 0.0), (-0.1, 0.05)])
    np.testing.assert_allclose(nodes[~known], [(0.05, 0.0)], atol=1e-12)
