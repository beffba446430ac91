"""Postures from which the camera sees the region of interest."""

from __future__ import annotations

import numpy as np

from palpate_models.numerics.frames import Array
from palpate_models.robot import lbr
from palpate_models.scenario.schema import ExamInput
from palpate_planning.motion.kinematics import ArmKinematics
from palpate_planning.motion.scene import CollisionScene, ViewPyramid, region_corners

VIEW_MARGIN_M = 0.03
"""The view is kept free about the region, too: perception wants a margin of surface."""
TURNS_RAD = (0.0, 1.2, -1.2, 2.2, -2.2)
"""Turns of the whole arm away from the table that are tried."""


def look_postures(known: ExamInput) -> list[Array]:
    """Postures to look from [rad], shape (7,) each: those that leave the view free first, in order of their turn.

    Home itself comes first if it does; folded postures turned about the vertical follow. None of them collides.
    """
    kinematics = ArmKinematics(known.robot, known.limits)
    size = (known.exam.region_m[0] + 2 * VIEW_MARGIN_M, known.exam.region_m[1] + 2 * VIEW_MARGIN_M)
    corners = region_corners(np.array(known.X_WA), known.exam.centre_m, size)
    view = ViewPyramid(kinematics, known.robot, np.array(known.camera.position_m), corners)
    scene = CollisionScene(kinematics, known.robot)
    postures = []
    for turn in TURNS_RAD:
        q = np.array(lbr.HOME)
        q[0] += turn
        if scene.free(q):
            postures.append(q)
    return sorted(postures, key=lambda q: not view.clear(q))
