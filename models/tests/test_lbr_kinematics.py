"""The arm's kinematics against pinocchio's of the same URDF, and the Jacobian against finite differences."""

import numpy as np
import pinocchio
import pytest

from palpate_models.robot import lbr
from palpate_models.robot.kinematics import link_transforms, tool_jacobian, tool_pose
from palpate_models.scenario.schema import Robot

ROBOT = Robot(base_yaw_rad=0.3)
POSES = [lbr.HOME, np.linspace(-1, 1, 7), np.full(7, 0.4)]


@pytest.mark.parametrize("q", POSES)
def test_every_link_is_where_the_urdf_has_it(q: np.ndarray) -> None:
    model = pinocchio.buildModelFromXML(lbr.urdf(ROBOT))
    data = model.createData()
    pinocchio.framesForwardKinematics(model, data, q)
    X = np.eye(4)
    for parent, child, X_PC in link_transforms(q, ROBOT):
        assert parent == "world" or model.existFrame(parent)
        X = X @ X_PC
        np.testing.assert_allclose(X, data.oMf[model.getFrameId(child)].homogeneous, atol=1e-9)
    np.testing.assert_allclose(X, tool_pose(q, ROBOT))


@pytest.mark.parametrize("q", POSES)
def test_the_jacobian_is_the_derivative_of_the_pose(q: np.ndarray) -> None:
    J = tool_jacobian(q, ROBOT)
    for joint, step in enumerate(np.eye(7) * 1e-6):
        slope = (tool_pose(q + step, ROBOT)[:3, 3] - tool_pose(q - step, ROBOT)[:3, 3]) / 2e-6
        np.testing.assert_allclose(J[:3, joint], slope, atol=1e-6)
