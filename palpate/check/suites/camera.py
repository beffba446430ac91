"""Role camera: frames on request, with intrinsics. If it renders `sim/surface`, the geometry is checked on a plane."""

from itertools import pairwise
from typing import Any

import numpy as np

from palpate.check.report import ConformanceReport
from palpate.check.rig import ReceivedMessage, Rig, Source
from palpate.check.shapes import level
from palpate_bus.contract import MS
from palpate_bus.messages import CameraTrigger
from palpate_bus.messages.geometry import transform_matrix
from palpate_bus.messages.stamps import header, nanoseconds
from palpate_models.numerics.frames import Array

IMAGE, INFO = "camera/depth/image_raw", "camera/depth/camera_info"
SMALL_IMAGE, SMALL_INFO = "camera/follow/depth", "camera/follow/camera_info"
SMALL_WIDTHS = (48, 192)
FRAME = "camera_depth_optical_frame"
FRAMES = 5
HALF_M = 0.15
"""Half the side of the plane."""
PITCH_M = 0.01
TOLERANCE_M = 0.01


def pose_of(message: Any) -> Array | None:
    """Return X_WC of the optical frame in a tf_static, shape (4, 4)."""
    for item in message.transforms:
        if item.child_frame_id == FRAME and item.header.frame_id == "world":
            return transform_matrix(item.transform)
    return None


def depths(message: Any) -> Array:
    """Return depth [m], shape (height, width); NaN where invalid."""
    rows = np.frombuffer(np.asarray(message.data, np.uint8).tobytes(), np.uint8).reshape(message.height, message.step)
    return rows[:, : 4 * message.width].copy().view("<f4").astype(float)


def plane(centre: Array) -> Source:
    """Return the source of a level square about `centre`, in world."""
    return lambda t: level(t, HALF_M, PITCH_M, centre)


def suite(rig: Rig, report: ConformanceReport) -> None:
    """Check pose, bursts, format and geometry."""
    report.section("pose")
    centre = np.array(rig.settings.scenario.camera.look_at_m)
    feed = {"sim/surface": plane(centre)}
    silent = rig.run(0.5, feed)
    calibrated = rig.last("tf_static")
    X_WC = None if calibrated is None else pose_of(calibrated)
    report.expect(
        "tf_static has the optical frame in world",
        X_WC is not None,
        f"world -> {FRAME}",
        "none" if X_WC is None else X_WC[:3, 3].round(3),
    )
    report.section("small images")
    _small(silent[SMALL_IMAGE], silent[SMALL_INFO], report)
    report.section("bursts")
    report.expect("takes no full frame without a request", not silent[IMAGE], "none", len(silent[IMAGE]))
    burst = _burst(rig, feed)
    images, infos = burst[IMAGE], burst[INFO]
    report.expect("takes as many frames as asked", len(images) == FRAMES, FRAMES, len(images))
    same = [i.message.header.stamp for i in images] == [i.message.header.stamp for i in infos]
    report.expect("intrinsics with every image, of the same stamp", same, f"{len(images)} pairs", f"{len(infos)} camera_info")
    period = rig.rules.topics[IMAGE].period
    gaps = [nanoseconds(b.message.header.stamp) - nanoseconds(a.message.header.stamp) for a, b in pairwise(images)]
    report.expect(
        "at its rate",
        all(abs(gap - period) <= rig.slack for gap in gaps),
        f"{period / MS:.0f} ms apart",
        [gap / MS for gap in gaps],
    )
    again = _burst(rig, feed)[IMAGE]
    report.expect("a second burst too", len(again) == FRAMES, FRAMES, len(again))
    if not images or not infos:
        return
    report.section("images")
    depth = _format(images[-1], infos[-1], report)
    if depth is not None and X_WC is not None:
        _geometry(depth, infos[-1].message, X_WC, centre, rig, report)


def _small(images: list[ReceivedMessage], infos: list[ReceivedMessage], report: ConformanceReport) -> None:
    """Check the small images, by which perception follows the wall: sent continuously, with their own intrinsics."""
    if not report.expect("sent without a request", bool(images), "some in half a second", len(images)):
        return
    same = [i.message.header.stamp for i in images] == [i.message.header.stamp for i in infos]
    report.expect("intrinsics with every one, of the same stamp", same, f"{len(images)} pairs", f"{len(infos)} camera_info")
    width = int(images[-1].message.width)
    least, most = SMALL_WIDTHS
    report.expect("are small", least <= width <= most, f"{least} to {most} pixels wide", width)
    if infos:
        _format(images[-1], infos[-1], report)


def _burst(rig: Rig, feed: dict[str, Source]) -> dict[str, list[ReceivedMessage]]:
    rig.send("planning/camera_trigger", CameraTrigger(header(rig.t), FRAMES))
    return rig.run(0.1 * FRAMES + 0.5 + rig.slack / 1e9, feed)


def _format(image: ReceivedMessage, info: ReceivedMessage, report: ConformanceReport) -> Array | None:
    m, k = image.message, np.asarray(info.message.k, np.float64).reshape(3, 3)
    report.expect("encoding", m.encoding == "32FC1" and not m.is_bigendian, "32FC1 [m], little-endian", f"{m.encoding}")
    fits = m.step >= 4 * m.width and len(m.data) == m.step * m.height
    report.expect("data fits the size", fits, "height x step bytes", f"{len(m.data)} bytes for {m.height} x {m.step}")
    size = (info.message.height, info.message.width)
    report.expect("camera_info is of that size", size == (m.height, m.width), (m.height, m.width), size)
    good = k[0, 0] > 0 and k[1, 1] > 0 and 0 < k[0, 2] < m.width and 0 < k[1, 2] < m.height and k[2, 2] == 1
    report.expect(
        "intrinsics are plausible", bool(good), "positive focal lengths, principal point in the image", k.round(1).tolist()
    )
    if m.encoding != "32FC1" or not fits:
        return None
    depth = depths(m)
    valid = depth[np.isfinite(depth)]
    ok = valid.size > 0 and bool(np.all((valid > 0) & (valid < 20)))
    report.expect(
        "depth is in metres, NaN where invalid",
        ok,
        "0 to 20 m",
        f"{valid.size} valid, {valid.min():.3g} to {valid.max():.3g}" if valid.size else "none",
    )
    return depth


def _geometry(depth: Array, info: Any, X_WC: Array, centre: Array, rig: Rig, report: ConformanceReport) -> None:
    """Check the depth of the pixels that see the plane."""
    if not rig.settings.motion:
        report.skip("geometry", "a real camera does not see sim/surface; look at a board of known pose")
        return
    k = np.asarray(info.k, np.float64).reshape(3, 3)
    v, u = np.indices(depth.shape)
    rays = np.stack(((u - k[0, 2]) / k[0, 0], (v - k[1, 2]) / k[1, 1], np.ones(depth.shape)), axis=-1) @ X_WC[:3, :3].T
    expected = (centre[2] - X_WC[2, 3]) / rays[..., 2]
    hit = X_WC[:3, 3] + rays * expected[..., None]
    on = (np.abs(hit[..., 0] - centre[0]) < 0.8 * HALF_M) & (np.abs(hit[..., 1] - centre[1]) < 0.8 * HALF_M) & (expected > 0)
    error = (depth - expected)[on & np.isfinite(depth)]
    seen = error.size / max(int(on.sum()), 1)
    bias = float(np.median(error)) if error.size else np.inf
    report.expect(
        "a level plane is where it is",
        seen > 0.5 and abs(bias) < TOLERANCE_M,
        f"within {TOLERANCE_M * 1e3:.0f} mm on most of its pixels",
        f"median {bias * 1e3:.2f} mm off on {100 * seen:.0f} % of them",
    )
