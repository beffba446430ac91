"""The tissue service against the contract, and standard presses by each tier's fast way."""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from tissue_messages import tool_state

from palpate_bus.messages import MS
from palpate_bus.messages.geometry import pose_matrix, vector
from palpate_bus.service import Service
from palpate_bus.testing import HandInbox
from palpate_models.numerics.frames import Array, apply, matrix
from palpate_models.patient.healthy import tension_of_ratio
from palpate_models.patient.motion import BodyMotion, Breathing, BreathingCurve, Motion
from palpate_models.patient.phantom import PhantomModel, build_phantom, flat_phantom
from palpate_models.patient.schema import Lesion, Phantom, Stiffness
from palpate_models.patient.wall import FADING_S
from palpate_models.scenario.errors import Errors, PoseErrors
from palpate_models.scenario.load import true_pose
from palpate_models.scenario.press import LIMIT_N, apparent_stiffness, depths
from palpate_models.scenario.schema import Exam, Scenario
from palpate_models.section import Pose as TruePose
from palpate_tissue.backend import TissueBackend
from palpate_tissue.backends.elastic.compliance import compliance
from palpate_tissue.backends.elastic.tissue import ElasticTissue
from palpate_tissue.backends.fmu.service import create as create_fmu
from palpate_tissue.backends.winkler.implicit import ImplicitTissue
from palpate_tissue.backends.winkler.presses import ENDS_S, contract
from palpate_tissue.backends.winkler.service import create
from palpate_tissue.backends.winkler.tissue import WinklerTissue
from palpate_tissue.moving import MovingBody
from palpate_tissue.surface import SkinSurface, nearest_on_triangles

LESION = Lesion(centre_m=(-0.02, 0.0))


def scenario(**phantom):
    still = {"breathing": Breathing(kind="none"), **phantom}
    return Scenario(errors=Errors(level="none"), phantom=Phantom(lesions=(LESION,), **still))


def tool(X_WA, t, p_A, v_A=(0.0, 0.0, 0.0)):
    """State of a tool at a place of the abdomen, at a tick."""
    return tool_state(t * MS, apply(X_WA, np.array((p_A,)))[0].tolist(), (X_WA[:3, :3] @ v_A).tolist())


def press(service, X_WA, depth=0.008, ticks=60, at=(0.0, 0.0)):
    inbox, out = HandInbox(), {}
    for k in range(ticks + 1):
        inbox.messages["sim/tool_state"] = tool(X_WA, k, (*at, 0.015 - depth * min(1, k / 30)))
        out.update(service.step(k * MS, inbox))
    return out


def test_truth_describes_the_phantom():
    case = scenario()
    truth = create(case).start()["truth/phantom"]
    model = build_phantom(case.phantom, case.seed)
    assert truth.surface.header.frame_id == "abdomen"
    np.testing.assert_allclose(truth.surface.vertices.reshape(-1, 3), model.vertices, atol=1e-7)
    np.testing.assert_array_equal(truth.stiffness, model.stiffness)
    np.testing.assert_array_equal(truth.lesion, model.lesion)
    np.testing.assert_allclose(vector(truth.pose.position), (0.56, 0.0, 0.93))


def test_wrench_and_depth_follow_the_true_pose_of_the_patient():
    """Turning patient and tool together turns the wrench; what registration gets wrong belongs to where the patient truly is."""
    registered = TruePose(xyz_m=(0.5, 0.1, 0.9), rpy_rad=(0.2, -0.1, 0.5))
    error = TruePose(xyz_m=(0.01, 0.02, 0.03), rpy_rad=(0.1, 0.0, 0.0))
    turned = {"exam": Exam(pose=registered), "errors": Errors(registration=PoseErrors(offset=error))}
    cases = [scenario(), scenario().model_copy(update=turned)]
    poses = [matrix(true_pose(case)) for case in cases]
    outs = [press(create(case), X_WA, at=(0.0053, 0.001)) for case, X_WA in zip(cases, poses, strict=True)]
    forces = [X_WA[:3, :3].T @ vector(out["sim/contact_wrench"].wrench.force) for X_WA, out in zip(poses, outs, strict=True)]
    assert forces[0][2] > 1
    np.testing.assert_allclose(forces[1], forces[0], rtol=1e-6, atol=1e-8)
    depths = [out["truth/indentation"].depth for out in outs]
    assert depths[0] == pytest.approx(depths[1], abs=1e-9)
    assert 0.007 < depths[0] < 0.009  # next to the umbilicus the surface is a little higher


def test_surface_shows_the_dent_and_the_report_counts_the_contact():
    case = scenario()
    service, X_WA = create(case), matrix(true_pose(case))
    out = press(service, X_WA, depth=0.010, ticks=100)
    surface, rest = out["sim/surface"], apply(X_WA, build_phantom(case.phantom, case.seed).vertices)
    moved = np.linalg.norm(surface.vertices.reshape(-1, 3) - rest, axis=1)
    assert moved.max() == pytest.approx(0.010, abs=0.0008)
    assert moved[np.linalg.norm(rest[:, :2] - (0.56, 0.0), axis=1) > 0.12].max() < 1e-4
    np.testing.assert_allclose(np.linalg.norm(surface.normals.reshape(-1, 3), axis=1), 1, atol=1e-6)
    facts = service.finish()
    assert facts["contact_onsets"] == 1
    assert facts["contact_steps"] > 20
    assert facts["peak_force_n"] > 0.5


def test_without_a_tool_the_abdomen_breathes_and_exerts_nothing():
    breathing = Breathing(kind="quiet", peak_to_peak_m=0.012, depth_cv=0, duration_cv=0)
    service, curve = create(scenario(breathing=breathing)), BreathingCurve(breathing, 0)
    inbox, tops = HandInbox(), []
    for k in range(0, 4301):
        out = service.step(k * MS, inbox)
        assert not vector(out["sim/contact_wrench"].wrench.force).any()
        if "truth/patient" in out:
            assert out["truth/patient"].excursion == curve.excursion(k / 1000)
        if "sim/surface" in out:
            tops.append(out["sim/surface"].vertices.reshape(-1, 3)[:, 2].max())
    assert 0.0115 < max(tops) - min(tops) <= 0.0121


def test_true_depth_is_counted_from_the_skin_as_the_breath_has_lifted_it():
    breathing = Breathing(kind="quiet", depth_cv=0)
    service, curve, inbox = create(scenario(breathing=breathing)), BreathingCurve(breathing, 0), HandInbox()
    inbox.messages["sim/tool_state"] = tool(matrix(true_pose(scenario())), 0, (0.0, 0.0, 0.045))  # 30 mm above the skin at rest
    sent = {k: service.step(k * MS, inbox) for k in range(3000)}
    depths = {k: out["truth/indentation"].depth for k, out in sent.items() if "truth/indentation" in out}
    lifts = np.array([curve.excursion(k / 1000) for k in depths])
    assert np.ptp(lifts) > 0.007
    np.testing.assert_allclose(np.array(list(depths.values())), -0.030 + lifts, atol=0.0002)


def test_nearest_rest_point_against_brute_force():
    model = build_phantom(Phantom(), 0)
    surface = SkinSurface(model)
    rng = np.random.default_rng(0)
    corners = model.vertices[model.triangles]
    for p in np.column_stack((rng.uniform(-0.1, 0.1, (40, 2)), rng.uniform(-0.03, 0.05, 40))):
        brute = np.sqrt(nearest_on_triangles(p, corners)[0].min())
        assert abs(surface.nearest(p).height) == pytest.approx(brute, abs=1e-5)


def test_a_process_that_stood_still_moves_the_tool_as_fast_as_it_went() -> None:
    """One millimetre in a tenth of a second: every sample received, only the last while catching up, or one late sample."""
    X_WA, peaks = matrix(true_pose(scenario())), []
    for received in ([(t, t) for t in range(101, 201)], [(t, 200) for t in range(101, 201)], [(200, 200)]):
        service, inbox = create(scenario()), HandInbox()
        press(service, X_WA, 0.006, 100)
        for t, k in received:
            inbox.messages["sim/tool_state"] = tool(X_WA, k, (0.0, 0.0, 0.009 - 1e-5 * (k - 100)))
            service.step(t * MS, inbox)
        peaks.append(service.finish()["peak_force_n"])
    assert peaks[1:] == pytest.approx([peaks[0]] * 2, rel=0.02)


MOVED = (Motion(kind="shift", at_s=0.02, over_s=0.1), Motion(kind="turn", at_s=0.02, over_s=0.1))
AFTER = 150
"""Tick at which the body lies still again."""


def moving_scenario(motion: Motion) -> Scenario:
    lying = Exam(pose=TruePose(xyz_m=(0.5, 0.1, 0.9), rpy_rad=(0.1, -0.05, 0.4)))
    return scenario(motion=motion, edge_m=0.008).model_copy(update={"seed": 5, "exam": lying})


def body_poses(case: Scenario) -> tuple[np.ndarray, np.ndarray]:
    """X_WA before, X_WA' after."""
    X_WA = matrix(true_pose(case))
    return X_WA, X_WA @ BodyMotion(case.phantom.motion, case.seed).pose(10.0)


def pressed(case: Scenario, X_WA: np.ndarray, make: Callable[[Scenario], Service] = create) -> dict[str, Any]:
    """Return the messages when the indenter presses and slides, along a path in A, on a body that is at X_WA."""
    service, inbox, out, start = make(case), HandInbox(), {}, AFTER
    service.start()
    for k in range(start + 151):
        share = np.clip((k - start) / 100, 0, 1)
        p_A, v_A = (-0.03 + 0.02 * share, 0.01, 0.020 - 0.012 * share), np.array((0.2, 0.0, -0.12)) * (0 < share < 1)
        inbox.messages["sim/tool_state"] = tool(X_WA, k, p_A, v_A) if k >= start else None
        out.update(service.step(k * MS, inbox))
    return out


@pytest.mark.parametrize("motion", MOVED, ids=lambda motion: motion.kind)
def test_the_moved_body_pressed_at_the_moved_place_feels_as_before(motion):
    case, still = moving_scenario(motion), moving_scenario(Motion())
    X_WA, X_WM = body_poses(case)
    assert np.abs(X_WM - X_WA).max() > 0.004
    before, after = pressed(still, X_WA), pressed(case, X_WM)
    in_body = [X[:3, :3].T @ vector(out["sim/contact_wrench"].wrench.force) for X, out in ((X_WA, before), (X_WM, after))]
    assert in_body[0][2] > 2
    np.testing.assert_allclose(in_body[1], in_body[0], rtol=1e-9, atol=1e-9)
    assert after["truth/indentation"].depth == pytest.approx(before["truth/indentation"].depth, abs=1e-12)
    carried = X_WM @ np.linalg.inv(X_WA)
    points = [vector(out["truth/indentation"].surface_point) for out in (before, after)]
    np.testing.assert_allclose(points[1], apply(carried, points[0][None])[0], atol=1e-12)
    np.testing.assert_allclose(pose_matrix(after["truth/patient"].pose), X_WM, atol=1e-12)
    np.testing.assert_allclose(pose_matrix(before["truth/patient"].pose), X_WA, atol=1e-12)
    skins = [out["sim/surface"].vertices.reshape(-1, 3) for out in (before, after)]
    np.testing.assert_allclose(skins[1], apply(carried, skins[0]), atol=3e-7)
    normals = [out["sim/surface"].normals.reshape(-1, 3) @ X[:3, :3] for X, out in ((X_WA, before), (X_WM, after))]
    np.testing.assert_allclose(normals[1], normals[0], atol=1e-6)


def test_an_fmu_is_carried_along_as_well():
    case = moving_scenario(MOVED[1])
    _, X_WM = body_poses(case)
    native, hosted = pressed(case, X_WM), pressed(case, X_WM, create_fmu)
    force = vector(native["sim/contact_wrench"].wrench.force)
    np.testing.assert_allclose(vector(hosted["sim/contact_wrench"].wrench.force), force, atol=1e-9 * np.linalg.norm(force))
    np.testing.assert_allclose(hosted["sim/surface"].vertices, native["sim/surface"].vertices, atol=3e-7)
    assert hosted["truth/patient"] == native["truth/patient"]


@pytest.mark.parametrize("motion", MOVED, ids=lambda motion: motion.kind)
def test_an_indenter_that_the_body_takes_along_is_not_rubbed(motion):
    """Held in the body's frame while that moves, it feels what an indenter feels that is held on a body at rest."""
    case = moving_scenario(motion.model_copy(update={"at_s": 0.2}))
    body, X_WA = BodyMotion(case.phantom.motion, case.seed), matrix(true_pose(case))
    p_A, forces = np.array((0.01, 0.02, 0.005)), []
    for moves in (False, True):
        service, inbox, felt = create(case if moves else moving_scenario(Motion())), HandInbox(), []
        for k in range(300):
            X = body.pose(k / 1000) if moves else np.eye(4)
            v, w = body.twist(k / 1000) if moves else np.zeros((2, 3))
            X_WM, at = X_WA @ X, X[:3, :3] @ p_A + X[:3, 3]
            p_W, v_W, w_W = apply(X_WM, p_A[None])[0], X_WA[:3, :3] @ (v + np.cross(w, at)), X_WA[:3, :3] @ w
            inbox.messages["sim/tool_state"] = tool_state(k * MS, p_W.tolist(), v_W.tolist(), w_W.tolist())
            out = service.step(k * MS, inbox)
            felt.append(X_WM[:3, :3].T @ vector(out["sim/contact_wrench"].wrench.force))
        forces.append(np.array(felt))
    assert forces[0][-1][2] > 2
    np.testing.assert_allclose(forces[1], forces[0], rtol=1e-7, atol=1e-7)


def test_the_latched_truth_and_all_before_the_motion_are_those_of_a_body_at_rest():
    case, still = moving_scenario(MOVED[0]), moving_scenario(Motion())
    moving, resting = create(case), create(still)
    assert (isinstance(moving, MovingBody), isinstance(resting, MovingBody)) == (True, False)
    poses = [pose_matrix(service.start()["truth/phantom"].pose) for service in (moving, resting)]
    np.testing.assert_array_equal(*poses)
    X_WA, _ = body_poses(case)
    inbox = HandInbox()
    inbox.messages["sim/tool_state"] = tool(X_WA, 0, (0.0, 0.0, 0.010))
    for k in range(21):
        sent = [service.step(k * MS, inbox)["sim/contact_wrench"].wrench for service in (moving, resting)]
        assert sent[0] == sent[1]
    assert moving.finish()["moved_at_s"] == 0.02


def test_the_mean_wrench_of_the_period_in_which_contact_ends_is_sent(monkeypatch):
    """With several sub-steps the sphere may touch in the first of them only."""
    service = create(scenario())
    monkeypatch.setattr(service.backend, "step", lambda *motion: (np.array((0.0, 0.0, 2.9)), np.zeros(3)))
    out = press(service, np.eye(4), ticks=1)
    assert not service.backend.touching
    assert np.linalg.norm(vector(out["sim/contact_wrench"].wrench.force)) == pytest.approx(2.9)


PRESSED = Lesion(centre_m=(0.01, 0.0), radii_m=(0.02, 0.015), contrast=4.0)

PLACES = np.array(((0.0, 0.0, 0.0), (0.012, 0.003, 0.0), (-0.04, 0.03, 0.0)))

UP = np.tile((0.0, 0.0, 1.0), (3, 1))
RADIUS = 0.015


def body(tense: bool = False) -> PhantomModel:
    model = flat_phantom(0.13, 0.006, lesions=(PRESSED,))
    return contracted(model) if tense else model


def contracted(model: PhantomModel) -> PhantomModel:
    return replace(model, tension=np.full(len(model.vertices), tension_of_ratio(2.6, Stiffness())), voluntary=True)


def solid(tense: bool = False) -> ElasticTissue:
    model = flat_phantom(0.06, 0.005)
    return ElasticTissue(contracted(model) if tense else model, compliance(model, (), np.inf))


TIERS = {
    "winkler": lambda: WinklerTissue(body()),
    "elastic": solid,
    "voluntary": lambda: WinklerTissue(body(tense=True)),
    "voluntary elastic": lambda: solid(tense=True),
}


@pytest.mark.parametrize("tier", TIERS)
def test_the_fast_way_is_the_slow_one(tier: str) -> None:
    tissue = TIERS[tier]()
    fast, _ = tissue.press(PLACES, UP, RADIUS)
    slow, _ = TissueBackend.press(tissue, PLACES, UP, RADIUS)
    assert fast == pytest.approx(slow, rel=2e-3)
    assert len(set(np.round(slow, 3))) == 3 or tier != "winkler"


def test_a_press_lets_voluntary_guarding_fade_by_a_quarter_and_involuntary_stays() -> None:
    """The expected value is written by hand: 20 mm/s provoke a quarter of the contraction, a hold at 10 mm provokes nothing."""
    ends = np.array(ENDS_S)
    level = contract(True, ends, depths(ends))
    at_depth = 0.25 + 0.75 * math.exp(-0.5 / FADING_S)
    assert level[ends == 0.5] == pytest.approx(at_depth)
    assert level[-1] == pytest.approx(at_depth * math.exp(-0.45 / FADING_S))
    assert level[-1] == pytest.approx(0.76, abs=0.005)
    assert contract(False, ends, depths(ends)).tolist() == [1.0] * len(ends)


def test_a_press_does_not_ask_what_was_touched_before() -> None:
    tissue = TIERS["voluntary"]()
    rested, _ = tissue.press(PLACES, UP, RADIUS)
    for k in range(3000):
        tissue.step(k * 1e-3, np.array((0.0, 0.0, 0.005)), np.zeros(3), RADIUS)
    assert tissue.activation < 0.5
    assert tissue.press(PLACES, UP, RADIUS)[0].tolist() == rested.tolist()


@pytest.mark.parametrize("tier", ["winkler", "elastic"])
def test_a_press_leaves_the_body_at_rest(tier: str) -> None:
    tissue = TIERS[tier]()
    one, _ = tissue.press(PLACES[:1], UP[:1], RADIUS)
    tissue.step(0.001, np.array((0.0, 0.0, 0.010)), np.zeros(3), RADIUS)
    assert np.abs(tissue.inward).max() > 0
    assert tissue.press(PLACES[:1], UP[:1], RADIUS)[0] == pytest.approx(one, rel=1e-12)
    tissue.settle()
    assert not tissue.inward.any()
    assert not tissue.touching


def test_what_is_read_is_the_end_of_the_hold_or_the_limit() -> None:
    forces = np.zeros((2, 1000))
    forces[0, 900:] = 3.0
    forces[0, 400] = 5.0
    forces[1, 450] = LIMIT_N + 1.0
    felt, limited = apparent_stiffness(forces)
    assert felt.tolist() == [3.0, LIMIT_N]
    assert limited.tolist() == [False, True]


def track(model: PhantomModel, breathing: BreathingCurve, dt: float) -> tuple[Array, Array]:
    """Along a line, back on the next one, and a stand: times [s] and centres [m] of the sphere, each `dt` [s]."""
    t = dt * np.arange(1, round(6.0 / dt) + 1)
    s = np.clip(0.03 * (t - 0.5), 0.0, 0.12)
    x, y = np.where(s < 0.06, s - 0.03, 0.09 - s), np.where(s < 0.06, 0.0, 0.0125)
    excursion = np.array([breathing.excursion(float(at)) for at in t])
    depth = np.minimum(0.02 * t, 0.010) + 0.2 * excursion
    return t, np.column_stack((x, y, RADIUS - depth))


def forces(tissue: TissueBackend, breathing: BreathingCurve) -> Array:
    """Mean force of each 10 ms of the track [N], shape (n, 3)."""
    t, p = track(tissue.model, breathing, tissue.dt)
    v = np.gradient(p, tissue.dt, axis=0)
    felt = np.array([tissue.step(float(at), p[k], v[k], RADIUS)[0] for k, at in enumerate(t)])
    return felt.reshape(-1, round(0.010 / tissue.dt), 3).mean(axis=1)


@pytest.mark.parametrize("breathing", [BreathingCurve(Breathing(kind="none"), 0), BreathingCurve(Breathing(), 3)])
def test_forces_are_those_of_the_explicit_steps(breathing: BreathingCurve) -> None:
    model = body()
    explicit = forces(WinklerTissue(model, breathing=breathing), breathing)
    implicit = forces(ImplicitTissue(model, breathing=breathing, dt=0.010), breathing)
    pressed = explicit[:, 2] > 1.0
    off = implicit[pressed, 2] / explicit[pressed, 2] - 1
    assert pressed.sum() > 400
    assert np.sqrt(np.mean(off**2)) < 0.01
    assert abs(off.mean()) < 0.005
    sliding = np.r_[100:240, 290:440]  # not where it jumps to the next line and turns
    assert implicit[sliding, 0] == pytest.approx(explicit[sliding, 0], abs=0.02 * float(explicit[:, 2].max()))


@pytest.mark.parametrize("tense", [False, True])
def test_a_press_feels_the_same_in_implicit_steps(tense: bool) -> None:
    explicit = WinklerTissue(body(tense))
    wanted, _ = explicit.press(PLACES, UP, RADIUS)
    felt, _ = explicit.in_steps_of(0.010).press(PLACES, UP, RADIUS)
    assert felt == pytest.approx(wanted, rel=5e-3)


def test_it_forgets_as_slowly() -> None:
    """Ten seconds after a press the skin still lies as deep as by explicit steps, under the sphere and around it."""
    model = body()
    left = []
    for tissue in (WinklerTissue(model), ImplicitTissue(model, dt=0.010)):
        for k in range(round(1.0 / tissue.dt)):
            tissue.step(k * tissue.dt, np.array((0.0, 0.0, RADIUS - 0.010)), np.zeros(3), RADIUS)
        for k in range(round(10.0 / tissue.dt)):
            tissue.idle(1.0 + k * tissue.dt)
        left.append(tissue.inward.copy())
    assert left[0].max() > 5e-5
    assert np.abs(left[1] - left[0]).max() < 0.05 * left[0].max()
