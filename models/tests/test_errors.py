"""Levels of errors, what of them can be set, and that what is drawn has the size that is said."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from palpate_models.numerics.frames import matrix
from palpate_models.scenario.errors import MOMENT_PER_FORCE_M, Errors, draw_errors, levels, table
from palpate_models.scenario.load import ScenarioError, load_scenario, true_pose
from palpate_models.section import Pose

ROOT = Path(__file__).resolve().parents[2]
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


@pytest.mark.parametrize(
    ("setting", "words"),
    [
        ("errors=bad", r"errors\.level = 'bad': .*'none', 'typical' or 'poor'"),
        ("errors=5", r"errors = 5: .*none, typical or poor"),
        ("errors.level=[poor]", r"errors\.level = \['poor'\]"),
        ("errors.force.tare_n=-1", r"errors\.force\.tare_n = -1: .*greater than or equal to 0"),
        ("errors.force.tara_n=1", r"errors\.force\.tara_n = 1: there is no such field\. Did you mean tare_n\?"),
        ("errors.hand_eye.translation_m=5", r"errors\.hand_eye\.translation_m = 5: .*less than or equal to 0\.1"),
        ("errors.camera=blind", r"errors\.camera = 'blind'"),
    ],
)
def test_what_cannot_be_is_named(setting: str, words: str) -> None:
    with pytest.raises(ScenarioError, match=words):
        level(setting)


def test_a_world_is_clean_only_without_any_error() -> None:
    assert level("errors=none").clean
    assert not level("errors=typical").clean
    assert not level("errors=none", "errors.arm.zero_rad=0.001").clean


def test_the_table_has_every_field_and_none_that_is_not() -> None:
    for section, rows in table().items():
        kind = type(getattr(Errors(), section))
        assert set(rows) == set(kind.model_fields) - {"offset"}
        for row in rows.values():
            assert set(row) == {"typical", "poor", "mark", "source"}
            assert row["mark"] in {"V", "S", "C", "A"}
    assert set(table()) == set(Errors.model_fields) - {"level"}


def test_poor_equipment_is_nowhere_better_than_typical() -> None:
    slower = {"tare_s", "warm_up_s"}
    for rows in table().values():
        assert all(row["poor"] >= row["typical"] for name, row in rows.items() if name not in slower)


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
    rough = {"rel": 0.1}
    share = np.array([d.force.sensitivity for d in drawn])
    assert share[:, range(6), range(6)].std() == pytest.approx(force.gain, **rough)
    assert share[:, 0, 1].std() == pytest.approx(force.cross_talk, **rough)
    assert share[:, 3, 0].std() == pytest.approx(force.cross_talk * MOMENT_PER_FORCE_M, **rough)
    bias = np.array([d.force.bias for d in drawn])
    assert 0.98 * force.bias_n < np.abs(bias[:, :3]).max() <= force.bias_n
    assert 0.98 * force.bias_nm < np.abs(bias[:, 3:]).max() <= force.bias_nm
    assert np.std([d.force.warm_up[:3] for d in drawn]) == pytest.approx(force.warm_up_n, **rough)
    offsets = np.abs([d.camera.offset_m for d in drawn])
    assert 0.95 * camera.offset_m < offsets.max() <= camera.offset_m
    assert np.mean([len(d.camera.lost) for d in drawn]) == pytest.approx(camera.lost_patches, **rough)
    for poses, given in (("X_CCt", errors.hand_eye), ("X_AAt", errors.registration)):
        X = np.array([getattr(d, poses) for d in drawn])
        assert X[:, :3, 3].std() == pytest.approx(given.translation_m, **rough)
        assert Rotation.from_matrix(X[:, :3, :3]).as_rotvec().std() == pytest.approx(given.rotation_rad, **rough)
    assert np.std([d.arm.origin_m for d in drawn]) == pytest.approx(arm.length_m, **rough)
    assert np.std([d.arm.zero_rad for d in drawn]) == pytest.approx(arm.zero_rad, **rough)
    assert np.log([d.arm.friction for d in drawn]).std() == pytest.approx(arm.friction, **rough)
    assert np.log([d.arm.damping for d in drawn]).std() == pytest.approx(arm.damping, **rough)
    assert np.log([d.arm.tool_mass for d in drawn]).std() == pytest.approx(arm.tool_mass, **rough)


def test_without_errors_the_equipment_is_nominal_but_for_the_bias() -> None:
    drawn = draw_errors(Errors(level="none"), 3)
    np.testing.assert_array_equal(drawn.force.sensitivity, np.eye(6))
    np.testing.assert_array_equal(drawn.X_CCt, np.eye(4))
    np.testing.assert_array_equal(drawn.X_AAt, np.eye(4))
    for values, nominal in ((drawn.arm.origin_m, 0), (drawn.arm.zero_rad, 0), (drawn.arm.friction, 1), (drawn.arm.damping, 1)):
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
