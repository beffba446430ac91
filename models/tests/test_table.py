"""Table and base stand where the other parts expect them."""

import numpy as np
import pytest

from palpate_models.robot.table import Box, boxes
from palpate_models.scenario.schema import Robot


def _corners(box: Box) -> np.ndarray:
    signs = np.array(np.meshgrid(*[(-0.5, 0.5)] * 3)).reshape(3, -1).T
    return signs * box.size @ box.X_WB[:3, :3].T + box.X_WB[:3, 3]


@pytest.fixture
def named() -> dict[str, Box]:
    return {box.name: box for box in boxes(Robot())}


def test_table_top_spans_what_the_scene_says(named: dict[str, Box]) -> None:
    corners = _corners(named["table_top"])
    np.testing.assert_allclose(corners.max(axis=0), [0.835, 1.0, 0.73])
    np.testing.assert_allclose(corners.min(axis=0)[:2], [0.285, -1.0])


def test_table_stands_on_the_floor_in_one_piece(named: dict[str, Box]) -> None:
    column, top = _corners(named["table_column"]), _corners(named["table_top"])
    assert column[:, 2].min() == pytest.approx(0.0)
    assert column[:, 2].max() == pytest.approx(top[:, 2].min())


def test_base_carries_the_robot_and_clears_the_table() -> None:
    robot = Robot(base_xy_m=(0.02, 0.3), base_height_m=0.6, base_yaw_rad=0.1)
    base = next(box for box in boxes(robot) if box.name == "robot_base")
    corners = _corners(base)
    assert corners[:, 2].min() == pytest.approx(0.0)
    assert corners[:, 2].max() == pytest.approx(robot.base_height_m)
    np.testing.assert_allclose(corners.mean(axis=0)[:2], robot.base_xy_m)
    assert corners[:, 0].max() < 0.285
