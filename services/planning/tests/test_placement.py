"""Kinematics in CasADi, postures along a scan, and where the base stands."""

import numpy as np
import pinocchio as pin
import pytest

from palpate_models.robot.arm import tool_pose, urdf
from palpate_models.robot.lbr import HOME, POSITION_LIMIT
from palpate_models.scenario.load import load_scenario
from palpate_models.scenario.schema import Robot, Scenario
from palpate_planning.placement import redundancy as placement
from palpate_planning.placement.redundancy import COST, PostureSequence, arm, base_of, plan_redundancy, prepare

ROBOT = Robot()


def dome(spacing: float = 0.02, half: float = 0.1, centre: tuple[float, float] = (0.56, 0.0)) -> tuple[np.ndarray, np.ndarray]:
    """Return a snake over a dome of 0.45 m radius about (x, y) with its crown at 0.93 m: positions and normals, shapes (n, 3)."""
    axis = np.linspace(-half, half, round(2 * half / spacing) + 1)
    xy = np.array([(x, y) for i, y in enumerate(axis) for x in (axis if i % 2 == 0 else axis[::-1])])
    normals = np.column_stack((xy, np.sqrt(0.45**2 - (xy**2).sum(axis=1)))) / 0.45
    return np.array([*centre, 0.93 - 0.45]) + 0.455 * normals, normals


@pytest.fixture(scope="module")
def scan() -> tuple[np.ndarray, np.ndarray, PostureSequence]:
    positions, normals = dome()
    return positions, normals, plan_redundancy(ROBOT, positions, normals, np.array(HOME))


@pytest.mark.parametrize("seed", range(2))
def test_functions_agree_with_the_urdf(seed: int) -> None:
    """Pose, Jacobian's rank measure and torque against pinocchio, for a base anywhere."""
    rng = np.random.default_rng(seed)
    robot = Robot(base_xy_m=tuple(rng.normal(size=2)), base_height_m=0.9, base_yaw_rad=float(rng.normal()), tool_mass_kg=0.6)
    model = pin.buildModelFromXML(urdf(robot))
    data = model.createData()
    q = rng.uniform(-1, 1, 7) * POSITION_LIMIT
    frame = model.getFrameId("indenter")
    J = pin.computeFrameJacobian(model, data, q, frame, pin.LOCAL_WORLD_ALIGNED)
    pose = pin.updateFramePlacement(model, data, frame)
    functions, base = arm(robot), base_of(robot)
    residual, _ = functions.task(q, base, pose.translation, pose.rotation * (1, 1, -1))
    np.testing.assert_allclose(np.array(residual), 0.0, atol=1e-12)
    press = J[:3].T @ (12.0 * pose.rotation[:, 2])
    torque = pin.computeGeneralizedGravity(model, data, q) + press
    np.testing.assert_allclose(np.array(functions.torque(q, base, 12.0))[:, 0], torque, atol=1e-9)
    scaled = J / np.array([[COST.reach_m]] * 3 + [[1.0]] * 3)
    assert float(functions.dexterity(q, base)) == pytest.approx(float(np.sqrt(np.linalg.det(scaled @ scaled.T))), abs=1e-9)


def test_planning_uses_what_was_prepared(scan: tuple[np.ndarray, np.ndarray, PostureSequence]) -> None:
    positions, normals, _ = scan
    robot = Robot(tool_mass_kg=0.41)
    prepare(robot, 9.0)
    made = placement._program.cache_info().misses
    assert plan_redundancy(robot, positions, normals, np.array(HOME), force_n=9.0).refined
    assert placement._program.cache_info().misses == made


def test_every_target_is_met_smoothly_within_limits(scan: tuple[np.ndarray, np.ndarray, PostureSequence]) -> None:
    """No change of branch: over the 20 mm between targets a joint turns by less than 0.5 rad (the elbow, nearly straight)."""
    positions, normals, postures = scan
    assert postures.reachable.all() and postures.refined
    poses = np.array([tool_pose(q, ROBOT) for q in postures.q])
    np.testing.assert_allclose(poses[:, :3, 3], positions, atol=1e-5)
    np.testing.assert_allclose(poses[:, :3, 2], -normals, atol=1e-5)
    np.testing.assert_allclose(postures.margin, (POSITION_LIMIT - np.abs(postures.q)).min(axis=1))
    assert postures.margin.min() > np.deg2rad(5)
    assert postures.torque_fraction.max() < 0.5
    assert np.abs(np.diff(postures.q, axis=0)).max() < 0.5


def test_what_is_out_of_reach_is_flagged_and_the_rest_is_served() -> None:
    positions, normals = dome(0.04)
    positions[7] += [0.8, 0.0, 0.0]
    positions[20] += [0.0, 0.0, 1.5]
    postures = plan_redundancy(ROBOT, positions, normals, np.array(HOME))
    assert np.flatnonzero(~postures.reachable).tolist() == [7, 20]
    assert postures.q.shape == (len(positions), 7)
    assert (np.abs(postures.q) <= POSITION_LIMIT).all()
    nowhere = plan_redundancy(ROBOT, positions[:2] + 5.0, normals[:2], np.array(HOME))
    assert not nowhere.reachable.any() and not nowhere.refined


@pytest.mark.parametrize("count", [1, 25])
def test_few_targets_and_a_wider_margin(count: int) -> None:
    positions, normals = (values[:count] for values in dome(0.05))
    postures = plan_redundancy(ROBOT, positions, normals, np.array(HOME), joint_margin_rad=0.15)
    assert postures.q.shape == (count, 7)
    assert postures.reachable.shape == (count,) and postures.reachable.all()
    assert postures.margin.min() >= 0.15 - 1e-9


def test_default_base_serves_the_default_scan() -> None:
    from palpate.arm.placement import PLACEMENT
    from palpate.run.clearance import scan_targets

    scenario = Scenario()
    for raised in (0.0, PLACEMENT.raised_m):
        positions, normals = scan_targets(scenario, scenario.exam.spacing_m, raised=raised)
        postures = plan_redundancy(scenario.robot, positions, normals, np.array(HOME))
        assert postures.reachable.all()
        assert np.rad2deg(postures.margin.min()) > 8
        assert postures.torque_fraction.max() < 0.4


@pytest.mark.slow
def test_default_base_is_what_the_optimisation_finds() -> None:
    from palpate.arm.placement import best_placement

    np.testing.assert_allclose(base_of(best_placement(Scenario())), base_of(ROBOT), atol=0.011)


@pytest.mark.slow
def test_a_height_that_is_given_is_kept() -> None:
    from palpate.arm.placement import best_placement

    robot = best_placement(load_scenario("lump", ["exam.region_m=[0.04,0.04]"]), height_m=0.905)
    assert robot.base_height_m == 0.905


def test_a_placement_counts_by_what_inverse_kinematics_reaches(monkeypatch: pytest.MonkeyPatch) -> None:
    from palpate.arm import placement

    far = ROBOT.model_copy(update={"base_xy_m": (-2.0, 0.0)})
    found = iter(((1.0, far), (2.0, ROBOT), (3.0, far), (4.0, far)))
    monkeypatch.setattr(placement, "_optimise", lambda *_: next(found))
    assert placement.best_placement(Scenario(), spacing=0.1) == ROBOT
