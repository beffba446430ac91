"""Role camera: frames on request, with intrinsics. If it renders `sim/surface`, the geometry is checked on a plane."""

from typing import Any, Final, NamedTuple

import numpy as np

from palpate.check.rig import ReceivedMessage, Rig, Source
from palpate.check.shapes import level
from palpate_bus.messages import MS, CameraTrigger, header, nanoseconds
from palpate_bus.messages.geometry import depth_in_metres, pose_of_frame
from palpate_camera.messages import FRAME, IMAGE, INFO, SMALL_IMAGE, SMALL_INFO
from palpate_models.numerics.frames import Array

SMALL_WIDTHS = (48, 192)


class ViewedPlane(NamedTuple):
    """The plane in front of the camera, and the burst."""

    frames: int = 5
    half_m: float = 0.15
    """Half the side of the plane."""
    pitch_m: float = 0.01


PLANE: Final = ViewedPlane()


def plane(centre: Array) -> Source:
    """Return the source of a level square about `centre`, in world."""
    return lambda t: level(t, PLANE.half_m, PLANE.pitch_m, centre)


def suite(rig: Rig) -> None:
    """Check pose, bursts, format and geometry."""
    rig.section("pose")
    centre = np.array(rig.settings.scenario.camera.look_at_m)
    feed = {"sim/surface": plane(centre)}
    silent = rig.run(0.5, feed)
    calibrated = rig.last("tf_static")
    X_WC = None if calibrated is None else pose_of_frame(calibrated, FRAME, "world")
    rig.arrives("tf_static has the optical frame in world", X_WC, f"world -> {FRAME}")
    rig.section("small images")
    _small(rig, silent[SMALL_IMAGE], silent[SMALL_INFO])
    rig.section("bursts")
    rig.equal("takes no full frame without a request", len(silent[IMAGE]), 0)
    burst = _burst(rig, feed)
    images, infos = burst[IMAGE], burst[INFO]
    rig.equal("takes as many frames as asked", len(images), PLANE.frames)
    rig.equal("intrinsics with every image, of the same stamp", _stamps(infos), stamps := _stamps(images))
    period = rig.contract.topics[IMAGE].period
    rig.below("at its rate", max(abs(np.diff(stamps) - period), default=0), rig.slack + 1, "ms off", 1 / MS)
    rig.equal("a second burst too", len(_burst(rig, feed)[IMAGE]), PLANE.frames)
    if not images or not infos:
        return
    rig.section("images")
    depth = _format(rig, images[-1], infos[-1])
    if depth is not None and X_WC is not None:
        _geometry(rig, depth, infos[-1].message, X_WC, centre)


def _stamps(received: list[ReceivedMessage]) -> list[int]:
    return [nanoseconds(item.message.header.stamp) for item in received]


def _small(rig: Rig, images: list[ReceivedMessage], infos: list[ReceivedMessage]) -> None:
    """Check the small images, by which perception follows the wall: sent continuously, with their own intrinsics."""
    if not rig.expect("sent without a request", bool(images), "some in half a second", len(images)):
        return
    rig.equal("intrinsics with every one, of the same stamp", _stamps(infos), _stamps(images))
    rig.within("are small", images[-1].message.width, *SMALL_WIDTHS, "pixels wide")
    if infos:
        _format(rig, images[-1], infos[-1])


def _burst(rig: Rig, feed: dict[str, Source]) -> dict[str, list[ReceivedMessage]]:
    rig.send("planning/camera_trigger", CameraTrigger(header(rig.t), PLANE.frames))
    return rig.run(0.1 * PLANE.frames + 0.5 + rig.slack_s, feed)


def _format(rig: Rig, image: ReceivedMessage, info: ReceivedMessage) -> Array | None:
    m, k = image.message, np.asarray(info.message.k, np.float64).reshape(3, 3)
    rig.expect("encoding", m.encoding == "32FC1" and not m.is_bigendian, "32FC1 [m], little-endian", f"{m.encoding}")
    fits = m.step >= 4 * m.width and len(m.data) == m.step * m.height
    rig.expect("data fits the size", fits, "height x step bytes", f"{len(m.data)} bytes for {m.height} x {m.step}")
    rig.equal("camera_info is of that size", (info.message.height, info.message.width), (m.height, m.width))
    good = k[0, 0] > 0 and k[1, 1] > 0 and 0 < k[0, 2] < m.width and 0 < k[1, 2] < m.height and k[2, 2] == 1
    rig.expect("intrinsics are plausible", bool(good), "focal lengths > 0, principal point in the image", k.round(1).tolist())
    if m.encoding != "32FC1" or not fits:
        return None
    depth = depth_in_metres(IMAGE, m).astype(float)
    rig.within("depth is in metres, NaN where invalid", depth[np.isfinite(depth)], 1e-3, 20.0, "m")
    return depth


def _geometry(rig: Rig, depth: Array, info: Any, X_WC: Array, centre: Array) -> None:
    """Check the depth of the pixels that see the plane."""
    if not rig.settings.motion:
        rig.skip("geometry", "a real camera does not see sim/surface; look at a board of known pose")
        return
    k = np.asarray(info.k, np.float64).reshape(3, 3)
    v, u = np.indices(depth.shape)
    rays = np.stack(((u - k[0, 2]) / k[0, 0], (v - k[1, 2]) / k[1, 1], np.ones(depth.shape)), axis=-1) @ X_WC[:3, :3].T
    expected = (centre[2] - X_WC[2, 3]) / rays[..., 2]
    hit = X_WC[:3, 3] + rays * expected[..., None]
    on = (np.abs(hit - centre)[..., :2] < 0.8 * PLANE.half_m).all(axis=-1) & (expected > 0)
    error = (depth - expected)[on & np.isfinite(depth)]
    enough = error.size > 0.5 * max(int(on.sum()), 1)
    rig.below("a level plane is where it is", abs(np.median(error)) if enough else np.inf, 0.01, "mm off", 1e3)
