"""A patient who moves: force, surface and truth go with the body."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from test_tissue_service import OneTopic, tool_state, vector

from palpate_bus.contract import MS
from palpate_bus.messages.geometry import pose_matrix
from palpate_bus.service import Service
from palpate_models.numerics.frames import apply, matrix
from palpate_models.patient.breathing import Breathing
from palpate_models.patient.motion import BodyMotion, Motion
from palpate_models.patient.schema import Lesion, Phantom
from palpate_models.scenario.errors import Errors
from palpate_models.scenario.load import true_pose
from palpate_models.scenario.schema import Exam, Scenario
from palpate_models.section import Pose
from palpate_tissue.backends.fmu.service import create as create_fmu
from palpate_tissue.backends.winkler.service import create
from palpate_tissue.moving import MovingBody

MOVED = (Motion(kind="shift", at_s=0.02, over_s=0.1), Motion(kind="turn", at_s=0.02, over_s=0.1))
LYING = Exam(pose=Pose(xyz_m=(0.5, 0.1, 0.9), rpy_rad=(0.1, -0.05, 0.4)))
AFTER = 150
"""Tick at which the body lies still again."""


def scenario(motion: Motion) -> Scenario:
    still = Breathing(kind="none")
    phantom = Phantom(lesions=(Lesion(centre_m=(-0.02, 0.0)),), breathing=still, motion=motion, edge_m=0.008)
    return Scenario(seed=5, exam=LYING, errors=Errors(level="none"), phantom=phantom)


def body_poses(case: Scenario) -> tuple[np.ndarray, np.ndarray]:
    """X_WA before, X_WA' after."""
    X_WA = matrix(true_pose(case))
    return X_WA, X_WA @ BodyMotion(case.phantom.motion, case.seed).pose(10.0)


def pressed(case: Scenario, X_WA: np.ndarray, make: Callable[[Scenario], Service] = create) -> dict[str, Any]:
    """Return the messages when the indenter presses and slides, along a path in A, on a body that is at X_WA."""
    service, inbox, out, start = make(case), OneTopic(), {}, AFTER
    service.start()
    for k in range(start + 151):
        share = np.clip((k - start) / 100, 0, 1)
        p_A, v_A = np.array((-0.03 + 0.02 * share, 0.01, 0.020 - 0.012 * share)), np.array((0.2, 0.0, -0.12)) * (0 < share < 1)
        p_W = apply(X_WA, p_A[None])[0]
        inbox.message = tool_state(k * MS, p_W.tolist(), (X_WA[:3, :3] @ v_A).tolist()) if k >= start else None
        out.update(service.step(k * MS, inbox))
    return out


@pytest.mark.parametrize("motion", MOVED, ids=lambda motion: motion.kind)
def test_the_moved_body_pressed_at_the_moved_place_feels_as_before(motion):
    case, still = scenario(motion), scenario(Motion())
    X_WA, X_WM = body_poses(case)
    assert np.abs(X_WM - X_WA).max() > 0.004
    before, after = pressed(still, X_WA), pressed(case, X_WM)
    in_body = [X[:3, :3].T @ vector(out["sim/contact_wrench"].wrench.force) for X, out in ((X_WA, before), (X_WM, after))]
    assert in_body[0][2] > 2
    np.testing.assert_allclose(in_body[1], in_body[0], rtol=1e-9, atol=1e-9)
    assert after["truth/indentation"].depth == pytest.approx(before["truth/indentation"].depth, abs=1e-12)
    points = [vector(out["truth/indentation"].surface_point) for out in (before, after)]
    np.testing.assert_allclose(points[1], apply(X_WM @ np.linalg.inv(X_WA), points[0][None])[0], atol=1e-12)
    np.testing.assert_allclose(pose_matrix(after["truth/patient"].pose), X_WM, atol=1e-12)
    np.testing.assert_allclose(pose_matrix(before["truth/patient"].pose), X_WA, atol=1e-12)
    skins = [out["sim/surface"].vertices.reshape(-1, 3) for out in (before, after)]
    np.testing.assert_allclose(skins[1], apply(X_WM @ np.linalg.inv(X_WA), skins[0]), atol=3e-7)
    normals = [out["sim/surface"].normals.reshape(-1, 3) @ X[:3, :3] for X, out in ((X_WA, before), (X_WM, after))]
    np.testing.assert_allclose(normals[1], normals[0], atol=1e-6)


def test_an_fmu_is_carried_along_as_well():
    case = scenario(MOVED[1])
    _, X_WM = body_poses(case)
    native, hosted = pressed(case, X_WM), pressed(case, X_WM, create_fmu)
    force = vector(native["sim/contact_wrench"].wrench.force)
    np.testing.assert_allclose(vector(hosted["sim/contact_wrench"].wrench.force), force, atol=1e-9 * np.linalg.norm(force))
    np.testing.assert_allclose(hosted["sim/surface"].vertices, native["sim/surface"].vertices, atol=3e-7)
    assert hosted["truth/patient"] == native["truth/patient"]


@pytest.mark.parametrize("motion", MOVED, ids=lambda motion: motion.kind)
def test_pressed_at_the_old_place_it_feels_otherwise(motion):
    case = scenario(motion)
    X_WA, _ = body_poses(case)
    there, moved = pressed(scenario(Motion()), X_WA), pressed(case, X_WA)
    forces = [np.linalg.norm(vector(out["sim/contact_wrench"].wrench.force)) for out in (there, moved)]
    assert abs(forces[1] / forces[0] - 1) > 0.05


@pytest.mark.parametrize("motion", MOVED, ids=lambda motion: motion.kind)
def test_an_indenter_that_the_body_takes_along_is_not_rubbed(motion):
    """Held in the body's frame while that moves, it feels what an indenter feels that is held on a body at rest."""
    case = scenario(motion.model_copy(update={"at_s": 0.2}))
    body, X_WA = BodyMotion(case.phantom.motion, case.seed), matrix(true_pose(case))
    p_A, forces = np.array((0.01, 0.02, 0.005)), []
    for moves in (False, True):
        service, inbox, felt = create(case if moves else scenario(Motion())), OneTopic(), []
        for k in range(300):
            X_WM = X_WA @ body.pose(k / 1000) if moves else X_WA
            v, w = body.twist(k / 1000) if moves else (np.zeros(3), np.zeros(3))
            at = body.pose(k / 1000)[:3, :3] @ p_A + body.pose(k / 1000)[:3, 3]
            v_W = X_WA[:3, :3] @ (v + np.cross(w, at))
            inbox.message = tool_state(k * MS, apply(X_WM, p_A[None])[0].tolist(), v_W.tolist())
            inbox.message.twist.angular.x, inbox.message.twist.angular.y, inbox.message.twist.angular.z = X_WA[:3, :3] @ w
            out = service.step(k * MS, inbox)
            felt.append(X_WM[:3, :3].T @ vector(out["sim/contact_wrench"].wrench.force))
        forces.append(np.array(felt))
    assert forces[0][-1][2] > 2
    np.testing.assert_allclose(forces[1], forces[0], rtol=1e-7, atol=1e-7)


def test_the_latched_truth_and_all_before_the_motion_are_those_of_a_body_at_rest():
    case, still = scenario(MOVED[0]), scenario(Motion())
    moving, resting = create(case), create(still)
    assert isinstance(moving, MovingBody)
    assert not isinstance(resting, MovingBody)
    poses = [pose_matrix(service.start()["truth/phantom"].pose) for service in (moving, resting)]
    np.testing.assert_array_equal(*poses)
    X_WA, _ = body_poses(case)
    inbox = OneTopic()
    inbox.message = tool_state(0, apply(X_WA, np.array(((0.0, 0.0, 0.010),)))[0].tolist())
    for k in range(21):
        sent = [service.step(k * MS, inbox)["sim/contact_wrench"].wrench for service in (moving, resting)]
        assert sent[0] == sent[1]
    assert moving.finish()["moved_at_s"] == 0.02
