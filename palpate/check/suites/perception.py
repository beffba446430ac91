"""Conformance of perception: the suite sends depth frames of a belly of known shape, and then none."""

from typing import Any

import numpy as np

from palpate.check import shapes
from palpate.check.report import ConformanceReport
from palpate.check.rig import Feed, Rig
from palpate.check.suites.camera import FRAME
from palpate_bus.messages import CameraInfo, CameraTrigger, RegionOfInterest, SurfaceMotion, TFMessage, TransformStamped
from palpate_bus.messages.geometry import depth_message, transform_message
from palpate_bus.messages.stamps import header
from palpate_models.numerics.frames import Array, apply, inverse, look_at
from palpate_models.scenario.load import exam_input

IMAGE, INFO = "camera/depth/image_raw", "camera/depth/camera_info"
SMALL_IMAGE, SMALL_INFO, MOTION = "camera/follow/depth", "camera/follow/camera_info", "perception/motion"
SURFACE, TARGETS = "perception/surface", "perception/targets"
FRAMES = 4
SIZE = (480, 640)
"""Height and width of the full image [px]."""
FOCAL = 525.0
"""[px]."""
FLOOR_M = -0.12
"""z of the floor in A."""
ANSWER_S = 10.0
"""Simulated time limit for the answer to a trigger."""


def suite(rig: Rig, report: ConformanceReport) -> None:
    """Check silence without a trigger, the surface of a known belly, and the answer without frames."""
    known = exam_input(rig.settings.scenario)
    X_WA = np.array(known.X_WA)
    camera = rig.settings.scenario.camera
    X_WC = look_at(np.array(camera.position_m), np.array(camera.look_at_m))
    K = np.array([[FOCAL, 0.0, SIZE[1] / 2], [0.0, FOCAL, SIZE[0] / 2], [0.0, 0.0, 1.0]])
    depth = shapes.depth_image(K, inverse(X_WA) @ X_WC, SIZE, FLOOR_M)
    report.section("bursts")
    rig.send("tf_static", _tf(X_WC))
    feed = _frames(depth, K)
    untriggered = rig.run(0.5, feed)
    report.expect(
        "sends nothing without a trigger", not untriggered[TARGETS], "no targets before a trigger", len(untriggered[TARGETS])
    )
    rig.send("planning/camera_trigger", CameraTrigger(header(rig.t), FRAMES))
    answered = _answer(rig, feed)
    if not report.expect(
        "answers a burst", answered, f"perception/targets within {ANSWER_S:.0f} s", "as expected" if answered else "nothing"
    ):
        return
    report.section("surface")
    _surface(rig, X_WA, report)
    _targets(rig, X_WA, report)
    report.section("following")
    _following(rig, depth, K, report)
    report.section("silence")
    before = len(rig.log[TARGETS])
    rig.send("planning/camera_trigger", CameraTrigger(header(rig.t), FRAMES))
    rig.run(0.1 * FRAMES + 2.0 + rig.slack / 1e9, {})
    late = rig.log[TARGETS][before:]
    ok = bool(late) and not len(late[-1].message.positions) and bool(late[-1].message.message)
    got = "no answer" if not late else f"{len(late[-1].message.positions)} targets: {late[-1].message.message}"
    report.expect("without frames it answers with no targets and a reason", ok, "an empty list with a message", got)


def _answer(rig: Rig, feed: Feed) -> bool:
    """Return True if targets arrive within ANSWER_S."""
    waited = 0.0
    while not rig.log[TARGETS] and waited < ANSWER_S:
        rig.run(0.5, feed)
        waited += 0.5
    return bool(rig.log[TARGETS])


def _following(rig: Rig, depth: Array, K: Array, report: ConformanceReport) -> None:
    """Check that it reports the motion of the wall from images with every eighth pixel."""
    K_small = np.diag((1 / 8, 1 / 8, 1.0)) @ K
    shown = rig.run(1.0, _frames(np.ascontiguousarray(depth[::8, ::8]), K_small, SMALL_IMAGE, SMALL_INFO))[MOTION]
    if report.expect(
        "reports the motion of the wall from small images", bool(shown), MOTION, "as expected" if shown else "nothing"
    ):
        count = SurfaceMotion.FORECASTS
        sizes = {len(received.message.forecast) for received in shown}
        report.expect("with its forecast", sizes == {count}, f"{count} values", sorted(sizes))


def _tf(X_WC: Array) -> Any:
    """Return the `tf2_msgs/TFMessage` of the camera's pose, shape (4, 4)."""
    return TFMessage([TransformStamped(header(0, "world"), FRAME, transform_message(X_WC))])


def _frames(depth: Array, K: Array, image: str = IMAGE, info: str = INFO) -> Feed:
    """Return the feed of a depth image [m] and its intrinsics, shape (3, 3)."""
    P = np.hstack((K, np.zeros((3, 1)))).ravel()
    whole = RegionOfInterest(0, 0, 0, 0, False)
    height, width = depth.shape
    pixels = depth.astype(np.float32)
    return {
        info: lambda t: CameraInfo(
            header(t, FRAME), height, width, "plumb_bob", np.zeros(5), K.ravel(), np.eye(3).ravel(), P, 0, 0, whole
        ),
        image: lambda t: depth_message(header(t, FRAME), pixels),
    }


def _surface(rig: Rig, X_WA: Array, report: ConformanceReport) -> None:
    """Check place, normals and triangles of the perceived surface."""
    message = rig.last(SURFACE)
    if not report.expect(
        "perceives a surface", message is not None, "perception/surface", "there" if message is not None else "none"
    ):
        return
    p_A = apply(inverse(X_WA), np.asarray(message.vertices, np.float64).reshape(-1, 3))
    n_W = np.asarray(message.normals, np.float64).reshape(-1, 3)
    error = np.abs(p_A[:, 2] - shapes.height(p_A[:, 0], p_A[:, 1]))
    near = np.hypot(p_A[:, 0], p_A[:, 1]) < 0.8 * shapes.REACH_M
    worst = float(np.quantile(error[near], 0.95)) if near.any() else np.inf
    report.expect("where it is", worst < 0.003, "95 % within 3 mm", f"{worst * 1e3:.2f} mm")
    n_A = n_W @ X_WA[:3, :3]
    angle = np.degrees(np.arccos(np.clip(np.sum(n_A * shapes.normals(p_A[:, 0], p_A[:, 1]), axis=1), -1, 1)))
    tilt = float(np.quantile(angle[near], 0.95)) if near.any() else np.inf
    report.expect("with outward normals", tilt < 10, "95 % within 10 degrees", f"{tilt:.1f} degrees")
    inside = int(np.max(message.triangles, initial=0)) < len(p_A)
    report.expect("triangles index its vertices", inside, "indices below the number of vertices")


def _targets(rig: Rig, X_WA: Array, report: ConformanceReport) -> None:
    """Check number, place and fused frames of the targets."""
    message = rig.last(TARGETS)
    p_W = np.array([(p.x, p.y, p.z) for p in message.positions]).reshape(-1, 3)
    sizes = {len(p_W), len(message.normals), len(message.lines)}
    report.expect("targets, each with normal and line", len(sizes) == 1 and len(p_W) > 0, "some, of equal number", sorted(sizes))
    report.expect("fused all frames", message.frames_fused == FRAMES, FRAMES, message.frames_fused)
    if not len(p_W):
        return
    exam = rig.settings.scenario.exam
    p_A = apply(inverse(X_WA), p_W)
    off = np.abs(p_A[:, :2] - np.array(exam.centre_m)) - np.array(exam.region_m) / 2
    report.expect(
        "within the region of interest", float(off.max()) < 0.01, "inside, to 10 mm", f"{off.max() * 1e3:.1f} mm beyond"
    )
    height = float(np.max(np.abs(p_A[:, 2] - shapes.height(p_A[:, 0], p_A[:, 1]))))
    report.expect("on the surface", height < 0.005, "within 5 mm", f"{height * 1e3:.2f} mm")
