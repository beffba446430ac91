"""Conformance of perception: the suite sends depth frames of a belly of known shape, and then none."""

from typing import Any, Final, NamedTuple

import numpy as np

from palpate.check import shapes
from palpate.check.rig import Feed, Rig
from palpate_bus.messages import CameraTrigger, SurfaceMotion, TFMessage, TransformStamped, header
from palpate_bus.messages.geometry import camera_info, depth_message, mesh_arrays, transform_message, vectors
from palpate_camera.messages import FRAME, IMAGE, INFO, SMALL_IMAGE, SMALL_INFO
from palpate_models.numerics.frames import Array, apply, inverse, look_at
from palpate_models.scenario.load import exam_input

MOTION, SURFACE, TARGETS = "perception/motion", "perception/surface", "perception/targets"


class SimulatedView(NamedTuple):
    """Images that the suite sends, and its patience."""

    frames: int = 4
    size_px: tuple[int, int] = (480, 640)
    """Height and width of the full image."""
    focal_px: float = 525.0
    floor_m: float = -0.12
    """z of the floor in A."""
    answer_s: float = 10.0
    """Simulated time limit for the answer to a trigger."""


VIEW: Final = SimulatedView()


def suite(rig: Rig) -> None:
    """Check silence without a trigger, the surface of a known belly, and the answer without frames."""
    known = exam_input(rig.settings.scenario)
    X_WA = np.array(known.X_WA)
    camera = rig.settings.scenario.camera
    X_WC = look_at(np.array(camera.position_m), np.array(camera.look_at_m))
    K = np.array([[VIEW.focal_px, 0.0, VIEW.size_px[1] / 2], [0.0, VIEW.focal_px, VIEW.size_px[0] / 2], [0.0, 0.0, 1.0]])
    depth = shapes.depth_image(K, inverse(X_WA) @ X_WC, VIEW.size_px, VIEW.floor_m)
    rig.section("bursts")
    rig.send("tf_static", _tf(X_WC))
    feed = _frames(depth, K)
    untriggered = rig.run(0.5, feed)
    rig.equal("sends nothing without a trigger", len(untriggered[TARGETS]), 0)
    rig.send("planning/camera_trigger", CameraTrigger(header(rig.t), VIEW.frames))
    answer = rig.await_message(TARGETS, VIEW.answer_s, feed)
    if not rig.arrives("answers a burst", answer, f"{TARGETS} within {VIEW.answer_s:.0f} s"):
        return
    rig.section("surface")
    _surface(rig, X_WA)
    _targets(rig, X_WA)
    rig.section("following")
    _following(rig, depth, K)
    rig.section("silence")
    before = len(rig.log[TARGETS])
    rig.send("planning/camera_trigger", CameraTrigger(header(rig.t), VIEW.frames))
    rig.run(0.1 * VIEW.frames + 2.0 + rig.slack_s, {})
    late = rig.log[TARGETS][before:]
    ok = bool(late) and not len(late[-1].message.positions) and bool(late[-1].message.message)
    got = "no answer" if not late else f"{len(late[-1].message.positions)} targets: {late[-1].message.message}"
    rig.expect("without frames it answers with no targets and a reason", ok, "an empty list with a message", got)


def _following(rig: Rig, depth: Array, K: Array) -> None:
    """Check that it reports the motion of the wall from images with every eighth pixel."""
    K_small = np.diag((1 / 8, 1 / 8, 1.0)) @ K
    shown = rig.run(1.0, _frames(np.ascontiguousarray(depth[::8, ::8]), K_small, SMALL_IMAGE, SMALL_INFO))[MOTION]
    if rig.arrives("reports the motion of the wall from small images", shown, MOTION):
        rig.equal("with its forecast", {len(received.message.forecast) for received in shown}, {SurfaceMotion.FORECASTS})


def _tf(X_WC: Array) -> Any:
    """Return the `tf2_msgs/TFMessage` of the camera's pose, shape (4, 4)."""
    return TFMessage([TransformStamped(header(0, "world"), FRAME, transform_message(X_WC))])


def _frames(depth: Array, K: Array, image: str = IMAGE, info: str = INFO) -> Feed:
    """Return the feed of a depth image [m] and its intrinsics, shape (3, 3)."""
    pixels = depth.astype(np.float32)
    return {
        info: lambda t: camera_info(header(t, FRAME), pixels.shape, K),
        image: lambda t: depth_message(header(t, FRAME), pixels),
    }


def _surface(rig: Rig, X_WA: Array) -> None:
    """Check place, normals and triangles of the perceived surface."""
    message = rig.last(SURFACE)
    if not rig.arrives("perceives a surface", message, SURFACE):
        return
    seen = mesh_arrays(message)
    p_A, n_A = apply(inverse(X_WA), seen.vertices), seen.normals @ X_WA[:3, :3]
    error = np.abs(p_A[:, 2] - shapes.height(p_A[:, 0], p_A[:, 1]))
    near = np.hypot(p_A[:, 0], p_A[:, 1]) < 0.8 * shapes.REACH_M
    rig.below("where it is", np.quantile(error[near], 0.95) if near.any() else np.inf, 0.003, "mm for 95 %", 1e3)
    angle = np.degrees(np.arccos(np.clip(np.sum(n_A * shapes.normals(p_A[:, 0], p_A[:, 1]), axis=1), -1, 1)))
    rig.below("with outward normals", np.quantile(angle[near], 0.95) if near.any() else np.inf, 10, "degrees for 95 %")
    inside = int(np.max(seen.triangles, initial=0)) < len(p_A)
    rig.expect("triangles index its vertices", inside, "indices below the number of vertices")


def _targets(rig: Rig, X_WA: Array) -> None:
    """Check number, place and fused frames of the targets."""
    message = rig.last(TARGETS)
    p_W = vectors(message.positions)
    sizes = {len(p_W), len(message.normals), len(message.lines)}
    rig.expect("targets, each with normal and line", len(sizes) == 1 and len(p_W) > 0, "some, of equal number", sorted(sizes))
    rig.equal("fused all frames", message.frames_fused, VIEW.frames)
    if not len(p_W):
        return
    exam = rig.settings.scenario.exam
    p_A = apply(inverse(X_WA), p_W)
    off = np.abs(p_A[:, :2] - np.array(exam.centre_m)) - np.array(exam.region_m) / 2
    rig.below("within the region of interest", off.max(), 0.01, "mm beyond", 1e3)
    rig.below("on the surface", np.max(np.abs(p_A[:, 2] - shapes.height(p_A[:, 0], p_A[:, 1]))), 0.005, "mm off", 1e3)
