"""Scenarios: files, settings, error levels and scan patterns; wrong input is named."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from palpate_models.numerics.frames import matrix
from palpate_models.scenario.errors import MOMENT_PER_FORCE_M, Errors, draw_errors, levels
from palpate_models.scenario.load import ScenarioError, dump_scenario, load_scenario, scenario_names, true_pose
from palpate_models.scenario.patterns import Scan, lattice, scan_of
from palpate_models.scenario.schema import BUILTIN_PATTERNS, Exam
from palpate_models.section import Pose
from palpate_plugins import PluginError


def scenario(folder: Path, text: str) -> str:
    """Return the path of a scenario file with this text."""
    path = folder / "mine.yaml"
    path.write_text(text, encoding="utf-8", errors="surrogateescape")
    return str(path)


@pytest.mark.parametrize("name", scenario_names())
def test_what_is_written_out_is_read_back(name: str, tmp_path: Path) -> None:
    loaded = load_scenario(name)
    assert load_scenario(scenario(tmp_path, dump_scenario(loaded))) == loaded


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("exam: {depth_m: deep}", r"mine\.yaml, line 1: exam\.depth_m = 'deep': .*number"),
        ("seed: 1\nexam:\n  depht_m: 0.01\n", r"line 3: exam\.depht_m = 0\.01: unknown field\. Did you mean depth_m\?"),
        ("exam: {pattern: snak}", r"exam\.pattern = 'snak': .*lines, raster, snake, search, or the path.*mean snake\?"),
        ("phantom: {lesions: [{contrast: 4}]}", r"phantom\.lesions\.0 = .*centre_m"),
        ("seed: 1\nexam: 3\n", r"mine\.yaml, line 2: exam = 3: .*section"),
        ("seed: 1\nexam: {region_m: [0.1, 0.1}\n", r"mine\.yaml, line 2, column \d+: not YAML"),
        ("- exam", r"expected a mapping of fields, not list"),
        ("exam: {", r"not YAML"),
        ("seed: \udcff", r"mine\.yaml.*not UTF-8"),
        ("seed: 2001-13-45", r"mine\.yaml.*month"),
        ("seed: " + "[" * 400, r"mine\.yaml.*nested more than 50 deep"),
        ("exam:\n  depth_m: 0.01\n  depth_m: 0.02\n", r"mine\.yaml: line 3: field depth_m is given twice"),
        ("seed: 1\nexam: {}\nseed: 2\n", r"mine\.yaml: line 3: field seed is given twice"),
        ("exam: {depth_m: 0.01, speed_mps: 0.02, depth_m: 0.01}", r"line 1: field depth_m is given twice"),
    ],
)
def test_what_cannot_be_is_named(text: str, words: str, tmp_path: Path) -> None:
    with pytest.raises(ScenarioError, match=words):
        load_scenario(scenario(tmp_path, text))


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        (["exam.speed_mps=0.02", "exam.depth_m=5"], r"^--set exam\.depth_m: exam\.depth_m = 5: .*less than"),
        (["seed=1", "phantom.mesh=belly.stl"], r"^--set phantom\.mesh: phantom = "),
        (["exam.depth_m=10"], r"exam\.depth_m = 10: .* 0\.05 \(in metres\)"),
        (["exam.region_m=[60, 60]"], r"exam\.region_m\.0 = 60: .* 1 \(in metres\)"),
        (["exam.speed_mps=fast"], r"exam\.speed_mps = 'fast': .*\(in metres per second\)"),
        (["exam.region_m=0.1"], r"exam\.region_m = 0\.1: expected a list"),
        (["exam.region_m=[0.1]"], r"exam\.region_m = \[0\.1\]: expected at least 2 values"),
        (["exam.region_m=[0.1, 0.1, 0.1]"], r"exam\.region_m = .*: expected at most 2 values"),
        (["limits.speed_mps=500"], r"limits\.speed_mps = 500"),
        (["limits.depth_m=20"], r"limits\.depth_m = 20"),
        (["exam.depth_m=0.04"], r"^lump[^(]*: limits\.depth_m = 0\.02 m: expected at least exam\.depth_m, 0\.04 m"),
        (["limits.force_emergency_n=40000"], r"limits\.force_emergency_n = 40000"),
        (["limits.workspace_min_m=[0.8, 0, 0]"], "expected -3 <= min < max <= 3"),
        (["errors=bad"], r"errors\.level = 'bad': .*'none', 'typical' or 'poor'"),
        (["errors=5"], r"errors = 5: .*none, typical or poor"),
        (["errors.level=[poor]"], r"errors\.level = \['poor'\]"),
        (["errors.force.tara_n=1"], r"errors\.force\.tara_n = 1: unknown field\. Did you mean tare_n\?"),
        (["errors.camera=blind"], r"errors\.camera = 'blind'"),
        (["exam.region_m.x=1"], "--set"),
        (["exam.region_m.2=1"], "--set"),
        (["phantom.lesions.-9=1"], "--set"),
        (["exam.depth_m=[" + "[" * 400], "--set"),
    ],
)
def test_a_value_is_blamed_on_the_setting_that_wrote_it_with_unit_and_count(settings: list[str], said: str) -> None:
    with pytest.raises(ScenarioError, match=said):
        load_scenario("lump", settings)


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("mine.yaml", r"mine\.yaml: there is no such file"),
        ("", "is a folder"),
        ("helthy", r"helthy: no such scenario.*Did you mean healthy\?"),
    ],
)
def test_a_scenario_that_is_not_there_is_refused(tmp_path: Path, name: str, said: str) -> None:
    with pytest.raises(ScenarioError, match=said):
        load_scenario(name if name == "helthy" else str(tmp_path / name))


def test_a_merged_section_may_be_overridden(tmp_path: Path) -> None:
    text = "robot: &base {base_height_m: 0.5}\nexam: {<<: {depth_m: 0.008, speed_mps: 0.02}, depth_m: 0.009}"
    loaded = load_scenario(scenario(tmp_path, text))
    assert (loaded.exam.depth_m, loaded.exam.speed_mps) == (0.009, 0.02)


def test_a_setting_is_read_like_a_file() -> None:
    assert load_scenario("healthy", ["exam.depth_m=8e-3"]).exam.depth_m == 0.008
    with pytest.raises(ScenarioError, match=r"--set exam=.*: line 1: field depth_m is given twice"):
        load_scenario("healthy", ["exam={depth_m: 0.01, depth_m: 0.02}"])


MANY = 400


def level(*settings: str) -> Errors:
    return load_scenario("healthy", settings).errors


def test_a_level_and_a_field_are_set_in_any_way() -> None:
    poor = levels()["poor"]["force"]
    assert level("errors=poor").force.noise_n == poor["noise_n"]
    assert level("errors.level=poor") == level("errors={level: poor}") == level("errors=poor")
    both = level("errors=poor", "errors.force.tare_n=0.01")
    assert (both.level, both.force.tare_n, both.force.noise_n) == ("poor", 0.01, poor["noise_n"])
    alone = level("errors=none", "errors.force.tare_n=0.3")
    assert alone.force.tare_n == 0.3
    assert alone.model_copy(update={"force": Errors(level="none").force}) == Errors(level="none")


def test_equal_seeds_give_equal_equipment_and_others_do_not() -> None:
    errors = Errors(level="poor")
    one, same, other = (draw_errors(errors, seed) for seed in (1, 1, 2))
    assert one.force.bias.tobytes() == same.force.bias.tobytes()
    assert one.X_AAt.tobytes() == same.X_AAt.tobytes()
    drawn = [(d.force.sensitivity, d.X_CCt[:3, 3], d.X_AAt[:3, 3], d.arm.zero_rad, d.camera.field) for d in (one, other)]
    for a, b in zip(*drawn, strict=True):
        assert not np.any(np.isclose(a[a != 0], b[a != 0], rtol=1e-6, atol=0))


def test_a_field_changes_nothing_of_what_the_others_are_drawn_to() -> None:
    plain, noisy = level("errors=poor"), level("errors=poor", "errors.camera.offset_m=0.0", "errors.force.gain=0.0")
    one, other = draw_errors(plain, 5), draw_errors(noisy, 5)
    assert other.camera.offset_m == 0.0
    assert one.camera.lost.tobytes() == other.camera.lost.tobytes()
    assert one.arm.origin_m.tobytes() == other.arm.origin_m.tobytes()
    off = ~np.eye(6, dtype=bool)
    np.testing.assert_array_equal(one.force.sensitivity[off], other.force.sensitivity[off])


def test_what_is_drawn_has_the_size_that_is_said() -> None:
    errors = Errors(level="poor")
    drawn = [draw_errors(errors, seed) for seed in range(MANY)]
    force, camera, arm = errors.force, errors.camera, errors.arm
    share, bias = (np.array([getattr(d.force, name) for d in drawn]) for name in ("sensitivity", "bias"))
    spread = {
        "gain": (share[:, range(6), range(6)], force.gain),
        "cross talk": (share[:, 0, 1], force.cross_talk),
        "cross talk of a moment": (share[:, 3, 0], force.cross_talk * MOMENT_PER_FORCE_M),
        "warm-up": ([d.force.warm_up[:3] for d in drawn], force.warm_up_n),
        "origins": ([d.arm.origin_m for d in drawn], arm.length_m),
        "zeros": ([d.arm.zero_rad for d in drawn], arm.zero_rad),
        "friction": (np.log([d.arm.friction for d in drawn]), arm.friction),
        "damping": (np.log([d.arm.damping for d in drawn]), arm.damping),
        "tool": (np.log([d.arm.tool_mass for d in drawn]), arm.tool_mass),
    }
    for poses, asked in (("X_CCt", errors.hand_eye), ("X_AAt", errors.registration)):
        X = np.array([getattr(d, poses) for d in drawn])
        spread[f"place of {poses}"] = (X[:, :3, 3], asked.translation_m)
        spread[f"turn of {poses}"] = (Rotation.from_matrix(X[:, :3, :3]).as_rotvec(), asked.rotation_rad)
    for name, (values, size) in spread.items():
        assert np.std(values) == pytest.approx(size, rel=0.1), name
    assert np.mean([len(d.camera.lost) for d in drawn]) == pytest.approx(camera.lost_patches, rel=0.1)
    uniform = ((bias[:, :3], force.bias_n), (bias[:, 3:], force.bias_nm), ([d.camera.offset_m for d in drawn], camera.offset_m))
    for values, size in uniform:
        assert 0.95 * size < np.abs(values).max() <= size


def test_without_errors_the_equipment_is_nominal_but_for_the_bias() -> None:
    drawn = draw_errors(Errors(level="none"), 3)
    arm = drawn.arm
    for values in (drawn.force.sensitivity, drawn.X_CCt, drawn.X_AAt):
        np.testing.assert_array_equal(values, np.eye(len(values)))
    for values, nominal in ((arm.origin_m, 0), (arm.zero_rad, 0), (arm.friction, 1), (arm.damping, 1)):
        np.testing.assert_array_equal(values, np.full(np.shape(values), nominal))
    assert (drawn.camera.offset_m, drawn.camera.warm_up_m, len(drawn.camera.lost), drawn.arm.tool_mass) == (0, 0, 0, 1)
    assert np.abs(drawn.force.bias).max() > 0


def test_the_true_pose_is_the_registered_one_composed_with_its_error() -> None:
    offset = Pose(xyz_m=(0.01, 0.0, 0.0), rpy_rad=(0.0, 0.0, 0.1))
    scenario = load_scenario(
        "healthy", ("exam.pose.rpy_rad=[0, 0, 1.5]", "errors=none", f"errors.registration.offset={offset.model_dump_json()}")
    )
    np.testing.assert_allclose(matrix(true_pose(scenario)), matrix(scenario.exam.pose) @ matrix(offset), atol=1e-12)
    drawn = load_scenario("poor_errors", seed=4)
    X_WA = matrix(drawn.exam.pose) @ draw_errors(drawn.errors, 4).X_AAt
    np.testing.assert_allclose(matrix(true_pose(drawn)), X_WA, atol=1e-12)
    assert not np.allclose(X_WA, matrix(drawn.exam.pose), atol=1e-4)


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
        ("x = 1", r"has no function scan\(exam, surface\)"),
        ("import nosuchthing\ndef scan(exam, surface): ...", "the module nosuchthing is not installed"),
        ("def scan(exam, surface):\n    return exam.nosuch", "line 2: AttributeError"),
        ("def scan(exam, surface):\n    return [(0, 0)]", "returned list, expected a Scan"),
        ("HEAD\ndef scan(exam, surface):\n    return Scan([np.zeros((3, 3))])", r"line 0 has shape \(3, 3\)"),
        ("HEAD\ndef scan(exam, surface):\n    return Scan([np.array([(0.9, 0.0)])])", r"800 mm outside of exam\.region_m"),
        ("HEAD\ndef scan(exam, surface):\n    return Scan([])", "0 targets, expected 1 to"),
        ("HEAD\ndef scan(exam, surface):\n    return Scan([np.zeros((2, 2))])", "targets 0 and 1 of line 0 are both at"),
        ("HEAD\ndef scan(exam, surface):\n    return Scan([np.zeros((1, 2))] * 2, joined=True)", "targets 0 and 1 are both at"),
    ],
)
def test_an_invalid_pattern_file_is_reported_with_its_line(tmp_path: Path, text: str, said: str) -> None:
    file = tmp_path / "mine.py"
    file.write_text(text.replace("HEAD", "import numpy as np\nfrom palpate_models.scenario.patterns import Scan"))
    with pytest.raises(PluginError, match=said):
        made(Exam(), str(file))
