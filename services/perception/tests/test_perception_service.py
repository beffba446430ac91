"""Perception with the real camera on the real phantom: accuracy, occlusion, calibration error, order, determinism."""

from collections.abc import Callable, Iterable
from functools import cache
from typing import Any

import numpy as np
import pytest
from scipy.interpolate import LinearNDInterpolator

from palpate_bus.messages import MS, CameraTrigger, SurfaceMotion, TFMessage, header, nanoseconds
from palpate_bus.messages.codes import ViewReason
from palpate_bus.messages.geometry import mesh_message
from palpate_bus.testing import HandInbox
from palpate_camera.backends.kinect.service import CameraService, transform
from palpate_models.numerics.frames import apply, inverse, matrix
from palpate_models.patient.phantom import PhantomModel, build_phantom
from palpate_models.scenario.load import exam_input, load_scenario, plant_input, true_pose
from palpate_models.scenario.patterns import lattice
from palpate_models.scenario.schema import Scenario
from palpate_perception.service import PerceptionService, create
from palpate_perception.tracker import FORECAST_S

TICK = 100 * MS


@cache
def phantom() -> PhantomModel:
    return build_phantom(Scenario().phantom, 0)


def scenario(*settings: str, seed: int = 0) -> Scenario:
    return load_scenario("clean", settings, seed)


def skin(case: Scenario, rise: float = 0.0) -> Any:
    """sim/surface of the phantom at rest, lifted by `rise` [m]."""
    p_W = apply(matrix(true_pose(case)), phantom().vertices) + np.array((0, 0, rise))
    return mesh_message(header(0, "world"), p_W, triangles=phantom().triangles)


@cache
def default_look() -> dict[str, Any]:
    """Result of the default scenario, shared by several tests."""
    return look(scenario())


def look(
    case: Scenario,
    frames: int | None = None,
    links: Any = None,
    rises: tuple[float, ...] = (0.0,),
    perception: PerceptionService | None = None,
) -> dict[str, Any]:
    """Return the messages of perception after a burst of the camera, by topic."""
    exam = plant_input(case)
    camera, perception = CameraService(exam), perception or PerceptionService(exam)
    wanted = frames or case.camera.frames
    seen = HandInbox().receive({"sim/link_poses": links} if links else {})
    inputs = HandInbox().receive(camera.start())
    trigger = {"planning/camera_trigger": CameraTrigger(header(5 * MS), wanted)}
    images: dict[str, Any] = {}
    for k in range(1, 120):
        start = trigger if k == 1 else {}
        sent = perception.step(k * TICK, inputs.receive({**start, **images}))
        if "perception/targets" in sent:
            return dict(sent)
        images = dict(camera.step(k * TICK, seen.receive({"sim/surface": skin(case, rises[k % len(rises)]), **start})))
    raise AssertionError("perception published nothing")


def whole(sent: Any) -> dict[str, Any]:
    """Return the messages of a camera without small images."""
    return {topic: sent[topic] for topic in sent if not topic.startswith("camera/follow")}


def vertices(message: Any) -> np.ndarray:
    return np.asarray(message.vertices, np.float64).reshape(-1, 3)


def xyz(items: Iterable[Any]) -> np.ndarray:
    return np.array([(p.x, p.y, p.z) for p in items])


def surface_error(case: Scenario, sent: dict[str, Any]) -> np.ndarray:
    """Perceived minus true height along z_A [m] at the phantom's vertices in the region."""
    perceived = apply(inverse(matrix(true_pose(case))), vertices(sent["perception/surface"]))
    width, height = case.exam.region_m
    true = phantom().vertices[phantom().normals[:, 2] > 0.3]
    true = true[(np.abs(true[:, 0]) <= width / 2) & (np.abs(true[:, 1]) <= height / 2)]
    assert len(true) > 1000
    return np.asarray(LinearNDInterpolator(perceived[:, :2], perceived[:, 2])(true[:, :2]) - true[:, 2])


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def test_the_surface_is_far_better_than_a_millimetre() -> None:
    sent = default_look()
    error = surface_error(scenario(), sent)
    targets = sent["perception/targets"]
    assert rms(error) < 0.15e-3  # asked for: 1 mm
    assert np.abs(error).max() < 0.8e-3
    assert abs(error.mean()) < 0.04e-3
    assert targets.frames_fused == 20
    assert targets.coverage == 1.0
    assert targets.message == ""
    assert 0.3 < targets.surface_noise / rms(error) < 3


def test_fewer_frames_are_noisier_and_the_estimate_says_so() -> None:
    case = scenario()
    few, many = look(case, 2), default_look()
    assert rms(surface_error(case, few)) > 1.5 * rms(surface_error(case, many))
    assert few["perception/targets"].surface_noise > 1.5 * many["perception/targets"].surface_noise
    assert few["perception/targets"].frames_fused == 2


def test_targets_lie_on_the_lattice_and_the_surface_with_unit_outward_normals() -> None:
    case = scenario()
    targets = default_look()["perception/targets"]
    p_A = apply(inverse(matrix(true_pose(case))), xyz(targets.positions))
    normals = xyz(targets.normals)
    x, y = lattice(case.exam)
    nodes = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1)
    nodes = np.concatenate((nodes[::2], nodes[1::2]))
    nodes[1::2] = nodes[1::2, ::-1].copy()
    np.testing.assert_allclose(p_A[:, :2], nodes.reshape(-1, 2), atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-9)
    assert (normals[:, 2] > 0.6).all()
    assert targets.lines.tolist() == np.repeat(np.arange(17), 17).tolist()
    # The true normals at the nearest vertices, away from the navel, where five millimetres turn the normal.
    true = phantom().vertices
    front = np.flatnonzero(phantom().normals[:, 2] > 0.3)
    nearest = front[np.argmin(np.linalg.norm(p_A[:, np.newaxis] - true[front], axis=2), axis=1)]
    away = np.hypot(p_A[:, 0], p_A[:, 1]) > 0.025
    angle = np.arccos(np.clip(np.sum(normals * phantom().normals[nearest], axis=1), -1, 1))
    assert np.rad2deg(angle[away]).max() < 4


def test_the_mesh_covers_region_and_margin_counter_clockwise_from_outside() -> None:
    mesh = default_look()["perception/surface"]
    p, n = vertices(mesh), np.asarray(mesh.normals, np.float64).reshape(-1, 3)
    triangles = mesh.triangles.reshape(-1, 3)
    np.testing.assert_allclose(p.min(axis=0)[:2], (0.56 - 0.125, -0.125), atol=1e-6)
    np.testing.assert_allclose(p.max(axis=0)[:2], (0.56 + 0.125, 0.125), atol=1e-6)
    assert len(triangles) == 2 * 50 * 50
    a, b, c = (p[triangles[:, k]] for k in range(3))
    face = np.cross(b - a, c - a)
    assert (np.sum(face * n[triangles[:, 0]], axis=1) > 0).all()


def test_the_robot_in_the_way_is_noticed_and_named() -> None:
    X = np.eye(4)
    X[:3, 3] = 0.62, -0.08, 1.15
    sent = look(scenario(), links=TFMessage([transform(0, "world", "lbr_link_4", X)]))
    targets = sent["perception/targets"]
    assert len(targets.positions) == len(targets.normals) == len(targets.lines) == 0
    assert 0.2 < targets.coverage < 0.95
    assert targets.reason == ViewReason.VIEW_BLOCKED
    assert "perception/surface" not in sent


@pytest.mark.parametrize(
    ("setting", "reason", "most_seen"),
    [
        ("camera.look_at_m=[2.0, -1.0, 1.5]", ViewReason.OUT_OF_IMAGE, 0.0),
        ("exam.region_m=[0.6, 0.3]", ViewReason.BEYOND_ABDOMEN, 1.0),
    ],
)
def test_a_region_that_is_not_seen_or_past_the_abdomen_has_no_targets(setting: str, reason: ViewReason, most_seen: float) -> None:
    targets = look(scenario(setting), 4)["perception/targets"]
    assert len(targets.positions) == 0
    assert targets.coverage <= most_seen
    assert targets.reason == reason


def test_a_wrong_extrinsic_calibration_shifts_the_surface_accordingly() -> None:
    # The published optical frame is 4 mm too far back along its axis, so all depths are 4 mm too small.
    case, shift = scenario("errors.hand_eye.offset.xyz_m=[0.0, 0.0, 0.004]"), 0.004
    error = surface_error(case, look(case))
    towards = np.array(case.camera.position_m) - np.array(case.camera.look_at_m)
    rise = shift * towards / np.linalg.norm(towards)
    true = phantom()
    region = (np.abs(true.vertices[:, :2]) <= 0.1).all(axis=1) & (true.normals[:, 2] > 0.3)
    n = true.normals[region]
    expected = n @ rise / n[:, 2]  # height above a fixed xy changes by the shift across the surface
    assert rms(error - expected) < 0.25e-3
    assert error.mean() == pytest.approx(expected.mean(), abs=0.05e-3)


def test_targets_are_about_the_registered_pose_and_the_surface_is_where_the_patient_truly_is() -> None:
    case = scenario("errors.registration.offset.xyz_m=[0.01, -0.008, 0.012]")
    sent = look(case)
    p_W = xyz(sent["perception/targets"].positions)
    np.testing.assert_allclose(p_W[:, :2].mean(axis=0), case.exam.pose.xyz_m[:2], atol=1e-6)
    perceived = apply(inverse(matrix(true_pose(case))), vertices(sent["perception/surface"]))
    true = phantom().vertices[(phantom().normals[:, 2] > 0.3) & (np.abs(phantom().vertices[:, :2]) < 0.1).all(axis=1)]
    error = LinearNDInterpolator(perceived[:, :2], perceived[:, 2])(true[:, :2]) - true[:, 2]
    assert rms(error) < 0.15e-3


def test_a_wall_that_breathes_is_perceived_at_the_end_of_expiration() -> None:
    case = scenario()
    rises = tuple(8e-3 * (0.5 - 0.5 * np.cos(2 * np.pi * k / 30)) for k in range(30))
    sent = look(case, 20, rises=rises)
    targets = sent["perception/targets"]
    assert len(targets.positions) == 289
    assert targets.message == ""
    assert abs(surface_error(case, sent).mean()) < 0.3e-3
    assert np.asarray(sent["perception/surface"].breathing).min() > 0.85  # all of it rises alike


def test_a_still_wall_is_answered_after_five_seconds_and_moves_by_nothing() -> None:
    (message,) = default_look()["perception/motion"]
    assert message.state == SurfaceMotion.LOST, "published before there is a surface"
    assert 5.0 < nanoseconds(default_look()["perception/targets"].header.stamp) / 1e9 < 6.0


def test_frames_older_than_the_trigger_do_not_count() -> None:
    case = scenario()
    exam = plant_input(case)
    camera, perception = CameraService(exam), PerceptionService(exam)
    inbox = HandInbox().receive(camera.start())
    old = {"sim/surface": skin(case), "planning/camera_trigger": CameraTrigger(header(0), 9)}
    stale = whole(camera.step(TICK, HandInbox().receive(old)))
    again = CameraTrigger(header(TICK + 50 * MS), 1)
    assert perception.step(2 * TICK, inbox.receive({**stale, "planning/camera_trigger": again})) == {}
    fresh = whole(camera.step(2 * TICK, HandInbox().receive({"planning/camera_trigger": again, "sim/surface": skin(case)})))
    assert perception.step(3 * TICK, inbox.receive(fresh))["perception/targets"].frames_fused == 1


def test_without_a_trigger_nothing_is_published() -> None:
    perception, camera = PerceptionService(exam_input(scenario())), CameraService(plant_input(scenario()))
    inbox = HandInbox().receive(camera.start())
    wake = {"sim/surface": skin(scenario()), "planning/camera_trigger": CameraTrigger(header(0), 2)}
    frame = whole(camera.step(0, HandInbox().receive(wake)))
    assert [perception.step(k * TICK, inbox.receive(frame)) for k in range(3)] == [{}, {}, {}]


@pytest.mark.parametrize(("away", "targets"), [(0.025, True), (0.05, False)])
def test_a_patient_who_moved_beyond_what_is_fitted_is_not_measured(away: float, targets: bool) -> None:
    case = scenario()
    perception = PerceptionService(plant_input(case))
    perception._follower.shift = np.array((0.0, -away))
    sent = look(case, perception=perception)["perception/targets"]
    assert (len(sent.positions) > 0) == targets
    assert sent.reason == (ViewReason.NONE if targets else ViewReason.PATIENT_MOVED)


def test_a_burst_without_frames_is_answered_in_words() -> None:
    perception, inbox = PerceptionService(exam_input(scenario())), HandInbox()
    inbox.receive({"planning/camera_trigger": CameraTrigger(header(0), 5)})
    sent = [perception.step(TICK, inbox)]
    sent += [perception.step(k * TICK, inbox.receive({})) for k in range(2, 20)]
    (answer,) = [outbox for outbox in sent if outbox]
    targets = answer["perception/targets"]
    assert (len(targets.positions), targets.coverage, targets.frames_fused) == (0, 0.0, 0)
    assert targets.reason == ViewReason.NO_FRAMES


def test_a_lost_camera_ends_the_burst_with_what_there_is() -> None:
    perception, inbox = PerceptionService(exam_input(scenario())), HandInbox()
    perception.step(TICK, inbox.receive({"planning/camera_trigger": CameraTrigger(header(0), 5)}))
    inbox.gone.add("camera")
    targets = perception.step(2 * TICK, inbox.receive({}))["perception/targets"]
    assert targets.reason == ViewReason.NO_CAMERA


def unreadable(frame: dict[str, Any]) -> None:
    frame["camera/depth/image_raw"].encoding = "mono8"


def larger_info(frame: dict[str, Any]) -> None:
    info = frame["camera/depth/camera_info"]
    info.width, info.height = 2 * info.width, 2 * info.height


def larger_image(frame: dict[str, Any]) -> None:
    info = frame["camera/depth/camera_info"]
    info.width, info.height = info.width // 2, info.height // 2


@pytest.mark.parametrize(
    ("spoil", "posed", "frames", "steps", "reason"),
    [
        (unreadable, True, 1, 15, ViewReason.BAD_FRAMES),
        (lambda frame: None, False, 1, 15, ViewReason.NO_CALIBRATION),
        (larger_info, True, 2, 3, ViewReason.BAD_FRAMES),  # answered at once: more frames will not help
        (larger_image, True, 2, 3, ViewReason.BAD_FRAMES),
    ],
)
def test_a_bad_frame_is_answered_with_its_reason(
    spoil: Callable[[dict[str, Any]], None], posed: bool, frames: int, steps: int, reason: ViewReason
) -> None:
    case = scenario()
    camera, perception = CameraService(plant_input(case)), create(case)
    trigger = {"planning/camera_trigger": CameraTrigger(header(0), frames)}
    frame = whole(camera.step(TICK, HandInbox().receive({"sim/surface": skin(case), **trigger})))
    spoil(frame)
    inbox = HandInbox().receive(camera.start() if posed else {})
    sent = [perception.step(TICK, inbox.receive(trigger))]
    sent += [perception.step(k * TICK, inbox.receive(frame if k == 2 else {})) for k in range(2, steps)]
    (answer,) = [outbox for outbox in sent if outbox]
    assert set(answer) == {"perception/targets"}
    assert len(answer["perception/targets"].positions) == 0
    assert answer["perception/targets"].reason == reason


def test_forecasts_are_at_the_times_that_the_message_says() -> None:
    assert np.allclose(FORECAST_S, 1e-3 * SurfaceMotion.FORECAST_STEP_MS * np.arange(SurfaceMotion.FORECASTS))
