"""A ROS camera's images, intrinsics and transforms through the bridge, and over zenoh."""

from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from palpate_bus.contract import contract
from palpate_bus.contract.port_check import violations
from palpate_bus.messages import (
    MS,
    CameraTrigger,
    Image,
    Quaternion,
    TFMessage,
    Transform,
    TransformStamped,
    Vector3,
    header,
    nanoseconds,
)
from palpate_bus.messages.geometry import camera_info
from palpate_bus.testing import HandInbox
from palpate_bus.wire.ros_node import RosNode
from palpate_bus.wire.zenoh_config import BusOptions
from palpate_camera.backends.ros import CameraPort, RosCameraService
from palpate_camera.inputs import CameraError
from palpate_models.scenario.schema import RosCamera

FRAME = "camera_depth_optical_frame"
METRES = np.array([[1.0, np.nan, 0.731], [0.5, 2.25, 1.125]], dtype=np.float32)


TAKEN = count(5)
"""Stamps of images [ns], each newer than the one before."""


def ros_image() -> Any:
    padded = np.zeros((2, 3 * 2 + 5), np.uint8)  # drivers may pad their rows
    padded[:, : 3 * 2] = np.nan_to_num(METRES * 1000).round().astype("<u2").view(np.uint8)
    return Image(header(next(TAKEN), FRAME), 2, 3, "16UC1", 0, padded.shape[1], padded.ravel())


def ros_info(d: float = 0.0) -> Any:
    K = np.array(((600.0, 0, 1.0), (0, 610.0, 0.5), (0, 0, 1)))
    return replace(camera_info(header(5, FRAME), (2, 3), K), d=np.full(5, d))


def link(parent: str, child: str, x: float, z_turn: float = 0.0) -> Any:
    rotation = Quaternion(0.0, 0.0, np.sin(z_turn / 2), np.cos(z_turn / 2))
    return TransformStamped(header(0, parent), child, Transform(Vector3(x, 0.0, 0.0), rotation))


TREE = [link("world", "stand", 1.0, np.pi / 2), link("stand", FRAME, 0.5)]


class Port(CameraPort):
    def __init__(self, tree: list[Any] = TREE) -> None:
        self.tree, self.waiting, self.intrinsics = list(tree), [ros_image()], ros_info()

    def images(self) -> list[Any]:
        waiting, self.waiting = self.waiting, []
        return waiting

    def info(self) -> Any:
        return self.intrinsics

    def transforms(self) -> list[Any]:
        tree, self.tree = self.tree, []
        return tree


def asked(frames: int) -> HandInbox:
    """Return an inbox with a trigger for this number of frames."""
    return HandInbox().put("planning/camera_trigger", CameraTrigger(header(0), frames))


def test_a_burst_is_passed_on_by_the_contract_and_old_frames_are_not() -> None:
    port = Port()
    service = RosCameraService(port)
    inbox = asked(2)
    port.waiting = [ros_image()]
    small = {"camera/follow/depth", "camera/follow/camera_info"}
    assert set(service.step(0, inbox)) == small, "a whole one taken before the trigger"
    for k in (1, 2):
        t = k * 100_000_000
        port.waiting = [ros_image(), ros_image()]
        out = service.step(t, inbox)
        for name, message in out.items():
            assert violations(contract().topics[name], message) == []
            assert nanoseconds(message.header.stamp) == t
        assert set(out) == {"camera/depth/image_raw", "camera/depth/camera_info"} | small
    port.waiting = [ros_image()]
    assert set(service.step(300_000_000, inbox)) == small
    assert service.step(400_000_000, inbox) == {}, "no new image"
    assert service.finish() == {"bursts": 1, "frames": 2, "frames_rejected": 0, "frames_repeated": 0, "problem": "",
                                "transforms_left_out": {}}  # fmt: skip


@pytest.mark.parametrize(("age_ms", "stamped_ms"), [(80, 920), (0, 1000), (5000, 1000), (-40, 1000)])
def test_an_image_has_the_time_of_its_exposure_unless_its_clock_is_another(age_ms: int, stamped_ms: int) -> None:
    """A camera's image is some 50 to 120 ms old when it comes, in which a wall that breathes moves by half a millimetre."""
    port = Port()
    image = ros_image()
    now = nanoseconds(image.header.stamp) + age_ms * MS
    service = RosCameraService(port, now=lambda: now)
    port.waiting = [image]
    (depth, info) = service.step(1000 * MS, HandInbox()).values()
    assert nanoseconds(depth.header.stamp) == nanoseconds(info.header.stamp) == stamped_ms * MS


def test_an_image_that_is_repeated_is_not_passed_on_as_new() -> None:
    port = Port()
    service = RosCameraService(port)
    image = ros_image()
    port.waiting = [image]
    assert service.step(0, HandInbox())
    port.waiting = [image]
    assert service.step(100_000_000, HandInbox()) == {}
    assert service.finish()["frames_repeated"] == 1


def intrinsics(rectified: bool, info: Any) -> Any:
    """Return the intrinsics that the bridge publishes for these. Raises CameraError if it refuses."""
    port = Port()
    port.rectified, port.intrinsics = rectified, info
    service = RosCameraService(port)
    inbox = asked(1)
    service.step(0, inbox)
    port.waiting = [ros_image()]
    return service.step(100_000_000, inbox).get("camera/depth/camera_info")


def test_a_rectified_image_has_the_intrinsics_of_p_and_no_distortion() -> None:
    """image_proc sends the raw image's camera_info with the rectified one: K and d are of the raw image, P is of this one."""
    info = ros_info(d=0.1)
    info.p = np.array([550.0, 0, 1.5, -22.0, 0, 560.0, 1.0, 0, 0, 0, 1, 0])
    said = intrinsics(True, info)
    assert said.k.reshape(3, 3).tolist() == [[550.0, 0, 1.5], [0, 560.0, 1.0], [0, 0, 1]]
    assert said.p.reshape(3, 4)[:, :3].tolist() == said.k.reshape(3, 3).tolist()
    assert not said.p.reshape(3, 4)[:, 3].any()
    assert not said.d.any()
    with pytest.raises(CameraError, match=r"d = \[0\.1"):
        intrinsics(False, info)


def test_without_p_or_without_rectification_k_counts() -> None:
    unset, raw = ros_info(), ros_info()
    unset.p = np.zeros(12)
    raw.p = np.array([550.0, 0, 1.5, 0, 0, 560.0, 1.0, 0, 0, 0, 1, 0])
    assert intrinsics(True, unset).k[0] == intrinsics(False, raw).k[0] == 600.0


def larger() -> Any:
    info = ros_info()
    info.width, info.height = 6, 4
    return info


def test_over_zenoh_as_rmw_zenoh_sends_it(tmp_path: Path) -> None:
    endpoint = f"unixsock-stream/{tmp_path}/ros.sock"
    node = RosNode("realsense", 0, BusOptions(listen=(endpoint,)))
    tf = node.publisher("tf_static", "tf2_msgs/msg/TFMessage", latched=True)
    tf.publish(TFMessage(TREE))  # before anyone subscribes
    images = node.publisher("camera/depth/image_rect_raw", "sensor_msgs/msg/Image")
    infos = node.publisher("camera/depth/camera_info", "sensor_msgs/msg/CameraInfo")
    camera = CameraPort(RosCamera(router=endpoint))
    assert camera.rectified
    service = RosCameraService(camera)
    inbox = asked(1)
    service.step(0, inbox)
    out: Any = {}
    for k in range(1, 200):
        infos.publish(ros_info())
        images.publish(ros_image())
        out = service.step(k * 100_000_000, inbox)
        if "camera/depth/image_raw" in out:
            break
    image = out["camera/depth/image_raw"]
    np.testing.assert_allclose(np.asarray(image.data).view("<f4").reshape(2, 3), METRES, atol=1e-3)
    node.close()


@pytest.mark.parametrize(
    ("info", "frame", "problem"),
    [
        (ros_info(d=0.1), FRAME, "rectified"),
        (larger(), FRAME, "3 x 2, camera_info says 6 x 4"),
        # Depth that is aligned to colour is in the colour camera's frame.
        (ros_info(), "camera_color_optical_frame", "set camera.ros.frame=camera_color_optical_frame"),
    ],
)
def test_an_image_that_does_not_fit_is_refused_with_the_reason(info: Any, frame: str, problem: str) -> None:
    port = Port()
    service, inbox, image = RosCameraService(port), asked(1), ros_image()
    port.intrinsics = info  # the driver was restarted
    service.step(0, inbox)
    image.header.frame_id = frame
    port.waiting = [image]
    assert service.step(100_000_000, inbox) == {}
    facts = service.finish()
    assert (facts["frames"], facts["frames_rejected"]) == (0, 1)
    assert problem in str(facts["problem"])
