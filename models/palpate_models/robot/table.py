"""The operating table and the robot's cubic base, as boxes in world."""

from typing import Final, NamedTuple

import numpy as np

from palpate_models.numerics.frames import Array, matrix, rigid
from palpate_models.scenario.schema import Robot
from palpate_models.section import Pose, Vec3


class OperatingTable(NamedTuple):
    """Measures of the operating table."""

    top_m: float = 0.73
    """Height of the table's top face (assumed)."""
    x_m: tuple[float, float] = (0.285, 0.835)
    y_m: tuple[float, float] = (-1.0, 1.0)
    thickness_m: float = 0.10
    column_m: tuple[float, float] = (0.30, 0.60)
    """Footprint of the table's column, x and y (assumed)."""


TABLE: Final = OperatingTable()
BASE_SIDE_M: Final = 0.40


class Box(NamedTuple):
    """A box B, aligned with its own frame at its centre."""

    name: str
    X_WB: Array
    """Homogeneous pose of the centre in world, shape (4, 4)."""
    size: Vec3
    """Full edge lengths along B's axes [m]."""


def _aligned_box(name: str, low: Vec3, high: Vec3) -> Box:
    X_WB = rigid(np.eye(3), (np.array(low) + np.array(high)) / 2)
    return Box(name, X_WB, (high[0] - low[0], high[1] - low[1], high[2] - low[2]))


def boxes(robot: Robot) -> tuple[Box, ...]:
    """Table top, table column and robot base, in world. The base reaches from the floor to `robot.base_height_m`."""
    under = TABLE.top_m - TABLE.thickness_m
    x, y = sum(TABLE.x_m) / 2, sum(TABLE.y_m) / 2
    height = robot.base_height_m
    base = Pose(xyz_m=(*robot.base_xy_m, height / 2), rpy_rad=(0.0, 0.0, robot.base_yaw_rad))
    return (
        _aligned_box("table_top", (TABLE.x_m[0], TABLE.y_m[0], under), (TABLE.x_m[1], TABLE.y_m[1], TABLE.top_m)),
        _aligned_box(
            "table_column",
            (x - TABLE.column_m[0] / 2, y - TABLE.column_m[1] / 2, 0.0),
            (x + TABLE.column_m[0] / 2, y + TABLE.column_m[1] / 2, under),
        ),
        Box("robot_base", matrix(base), (BASE_SIDE_M, BASE_SIDE_M, height)),
    )
