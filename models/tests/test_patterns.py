"""Scan patterns: the lattice of ours and its order, and what of somebody's own is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from palpate_models.scenario.load import ScenarioError, load_scenario
from palpate_models.scenario.patterns import Scan, lattice, scan_of
from palpate_models.scenario.schema import BUILTIN_PATTERNS, Exam
from palpate_plugins import PluginError

SPIRAL = Path(__file__).parents[2] / "docs" / "examples" / "spiral.py"
exams = st.builds(
    Exam,
    region_m=st.tuples(st.floats(0.03, 0.4), st.floats(0.03, 0.4)),
    centre_m=st.tuples(st.floats(-0.1, 0.1), st.floats(-0.1, 0.1)),
    spacing_m=st.floats(0.004, 0.05),
)


def flat(xy: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    return np.column_stack((xy, np.zeros(len(xy)))), np.tile((0.0, 0.0, 1.0), (len(xy), 1))


def made(exam: Exam, pattern: str) -> Scan:
    return scan_of(exam.model_copy(update={"pattern": pattern}), flat)


@settings(deadline=None)
@given(exams)
def test_the_lattice_covers_the_region_with_both_ends(exam: Exam) -> None:
    for axis, station in enumerate(lattice(exam)):
        centre, length = exam.centre_m[axis], exam.region_m[axis]
        np.testing.assert_allclose((station[0], station[-1]), (centre - length / 2, centre + length / 2), atol=1e-12)
        gaps = np.diff(station)
        assert (gaps > 0).all()
        assert (gaps <= exam.spacing_m * (1 + 1e-6)).all()
        np.testing.assert_allclose(gaps, gaps[0], rtol=1e-6)
        assert gaps[0] > exam.spacing_m / 2 - 1e-9  # no more lines than needed


def test_the_default_region_has_seventeen_lines_of_seventeen_points() -> None:
    x, y = lattice(Exam())
    assert (len(x), len(y)) == (17, 17)
    np.testing.assert_allclose(np.diff(x), 0.0125)


@settings(deadline=None, max_examples=30)
@given(exams, st.sampled_from(BUILTIN_PATTERNS))
def test_every_node_is_visited_once_line_by_line(exam: Exam, pattern: str) -> None:
    scan, nodes = made(exam, pattern), np.stack(np.meshgrid(*lattice(exam), indexing="ij"), axis=-1)
    order = [int(np.argmin(np.abs(nodes[:, 0, 0] - line[0, 0]))) for line in scan.lines]
    assert sorted(order) == list(range(len(nodes)))
    for k, (line, where) in enumerate(zip(scan.lines, order, strict=True)):
        assert np.array_equal(line, nodes[where][::-1] if pattern != "raster" and k % 2 else nodes[where])
    assert scan.joined is (pattern == "snake")
    if pattern != "lines":
        assert order == list(range(len(nodes)))


def test_no_line_follows_the_one_beside_it() -> None:
    """Skin that has just been pressed would be found too deep."""
    x = np.array([line[0, 0] for line in made(Exam(), "lines").lines])
    assert np.abs(np.diff(x)).min() > 0.024


def test_a_pattern_of_ones_own_is_a_file_with_a_function() -> None:
    scan = made(Exam(region_m=(0.1, 0.1)), str(SPIRAL))
    (line,) = scan.lines
    radius = np.hypot(*line.T)
    assert (np.diff(radius) >= 0).all()
    assert radius.max() <= 0.05
    steps = np.linalg.norm(np.diff(line, axis=0), axis=1)
    assert steps.max() < 1.5 * Exam().spacing_m
    assert 40 < len(line) < 80


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (None, "there is no such file"),
        ("def scan(:", r"is not Python: .*line 1"),
        ("x = 1", r"has no function scan\(exam, surface\)"),
        ("import nosuchthing\ndef scan(exam, surface): ...", "line 1: the module nosuchthing is not installed"),
        ("def scan(exam, surface):\n    return exam.nosuch", "line 2: AttributeError"),
        ("def scan(exam, surface):\n    return [(0, 0)]", "returned list, want a Scan"),
        ("HEAD\ndef scan(exam, surface):\n    return Scan([np.zeros((3, 3))])", r"line 0 has the shape \(3, 3\)"),
        ("HEAD\ndef scan(exam, surface):\n    return Scan([np.array([(0.9, 0.0)])])", r"800 mm outside of exam\.region_m"),
        ("HEAD\ndef scan(exam, surface):\n    return Scan([])", "0 targets, want 1 to"),
    ],
)
def test_an_invalid_pattern_file_is_reported_with_its_line(tmp_path: Path, text: str | None, said: str) -> None:
    file = tmp_path / "mine.py"
    if text is not None:
        file.write_text(text.replace("HEAD", "import numpy as np\nfrom palpate_models.scenario.patterns import Scan"))
    with pytest.raises(PluginError, match=said):
        made(Exam(), str(file))


def test_a_name_that_is_none_is_refused_with_what_there_is() -> None:
    with pytest.raises(ScenarioError, match=r"exam\.pattern = 'snak': .*lines, raster, snake, search, or the path.*mean snake\?"):
        load_scenario("clean", ["exam.pattern=snak"])
