"""Images, intrinsics and transforms of other cameras: the recording and the ROS bridge accept and refuse the same ones."""

from collections.abc import Callable
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from palpate_bus import messages as msg
from palpate_bus.contract import contract
from palpate_bus.contract.port_check import violations
from palpate_bus.messages.codec import encode
from palpate_bus.messages.geometry import camera_info, transform_matrix
from palpate_bus.recordings import open_recording
from palpate_bus.service import Service
from palpate_bus.testing import HandInbox
from palpate_bus.wire.ros_node import RosNode
from palpate_bus.wire.zenoh_config import BusOptions
from palpate_camera.backends.replay import POSE, ReplayedCamera
from palpate_camera.backends.ros import CameraPort, RosCameraService
from palpate_camera.messages import FRAME, IMAGE, INFO, SMALL_IMAGE, SMALL_INFO, CameraError
from palpate_errors import UserError
from palpate_models.scenario.schema import RosCamera
from palpate_recorder.service import RecorderService

WIDTH, HEIGHT = 8, 6
UNIT, HALF = (0.0, 0.0, 0.0, 1.0), (0.5, -0.5, 0.5, -0.5)
NAN = float("nan")
METRES = np.array([[1.0, np.nan, 0.731], [0.5, 2.25, 1.125]], dtype=np.float32)
TAKEN = count(5)
"""Stamps of images [ns], each newer than the one before."""


def link(parent: str, child: str, q: tuple[float, ...] = HALF, p: tuple[float, ...] = (0.1, 0.2, 0.3)) -> Any:
    return msg.TransformStamped(msg.header(0, parent), child, msg.Transform(msg.Vector3(*p), msg.Quaternion(*q)))


TREE = [link("world", "stand", (0.0, 0.0, np.sin(np.pi / 4), np.cos(np.pi / 4)), (1.0, 0.0, 0.0)),
        link("stand", FRAME, UNIT, (0.5, 0.0, 0.0))]  # fmt: skip


def ros_image() -> Any:
    padded = np.zeros((2, 3 * 2 + 5), np.uint8)  # drivers may pad their rows
    padded[:, : 3 * 2] = np.nan_to_num(METRES * 1000).round().astype("<u2").view(np.uint8)
    return msg.Image(msg.header(next(TAKEN), FRAME), 2, 3, "16UC1", 0, padded.shape[1], padded.ravel())


def ros_info(d: float = 0.0) -> Any:
    K = np.array(((600.0, 0, 1.0), (0, 610.0, 0.5), (0, 0, 1)))
    return replace(camera_info(msg.header(5, FRAME), (2, 3), K), d=np.full(5, d))


class Port(CameraPort):
    def __init__(self, image: Any = None, info: Any = None, tree: list[Any] = TREE) -> None:
        self.tree, self.waiting, self.intrinsics = list(tree), [image or ros_image()], info or ros_info()

    def images(self) -> list[Any]:
        waiting, self.waiting = self.waiting, []
        return waiting

    def info(self) -> Any:
        return self.intrinsics

    def transforms(self) -> list[Any]:
        tree, self.tree = self.tree, []
        return tree


class Seen:
    """Messages of a good camera, for a test to change."""

    def __init__(self) -> None:
        depth = np.full((HEIGHT, WIDTH), 0.75, "<f4")
        self.image = msg.Image(msg.header(5, FRAME), HEIGHT, WIDTH, "32FC1", 0, 4 * WIDTH, depth.view(np.uint8).ravel())
        self.k = np.array([600.0, 0, 3.5, 0, 610.0, 2.5, 0, 0, 1])
        self.d = np.zeros(5)
        self.size = (HEIGHT, WIDTH)
        self.info_frame = FRAME
        self.binning_x = 0
        self.roi = msg.RegionOfInterest(0, 0, 0, 0, False)
        self.transforms = [link("world", FRAME)]

    @property
    def info(self) -> Any:
        plain = camera_info(msg.header(5, self.info_frame), self.size, self.k.reshape(3, 3))
        return replace(plain, d=self.d, binning_x=self.binning_x, roi=self.roi)


def bridged(seen: Seen, _: Path) -> Service:
    return RosCameraService(Port(seen.image, seen.info, seen.transforms), wait_s=0.0)


def replayed(seen: Seen, folder: Path) -> Service:
    recorder = RecorderService(folder / "recording_mcap")
    for topic, message in ((IMAGE, seen.image), (INFO, seen.info), (POSE, msg.TFMessage(seen.transforms))):
        row = contract().topics[topic]
        recorder.record(row, encode(message, row.type), 5 * msg.MS, 1)
    recorder.finish()
    return ReplayedCamera(open_recording(folder / "recording_mcap"))


Camera = Callable[[Seen, Path], Service]


def k(fx: float = 600.0, fy: float = 600.0, cx: float = 3.5, cy: float = 2.5, skew: float = 0.0, last: float = 1.0) -> Any:
    return np.array([fx, skew, cx, 0.0, fy, cy, 0.0, 0.0, last])


def of_depth(depth: float, kind: str = "<f4") -> Any:
    return np.full(WIDTH * HEIGHT, depth, kind).view(np.uint8)


REFUSED = [
    ("d", np.array([0.12, 0, 0, 0, 0]), r"d = \[.*rectify"),
    ("d", np.full(5, NAN), r"d = \[.*rectify"),
    ("d", np.array([-0.3, 0.1, 0, 0, 0, 0.01, 0.02, 0.03]), r"d = \[.*rectify"),
    ("k", k(fx=NAN), "k = "),
    ("k", k(fx=-600.0), "k = "),
    ("k", k(cx=NAN), "k = "),
    ("k", k(0.09, 0.11, 0.5, 0.5), "k = "),  # as shares of the image
    ("k", k(cx=319.5, cy=239.5), "k = "),  # of another resolution
    ("k", k(cx=1.5, cy=1.0), "k = "),
    ("k", k(fy=200.0), "k = "),
    ("k", k(1e7, 1e7), "k = "),
    ("k", k(skew=3.0), "k = .*expected fx, 0, cx"),
    ("k", k(last=2.0), "k = .*expected fx, 0, cx"),
    ("k", np.eye(3).ravel(), r"k = .*principal point|k = .*focal"),
    ("binning_x", 2, "binning or a region of interest"),
    ("roi", msg.RegionOfInterest(0, 1, HEIGHT // 2, WIDTH // 2, False), "binning or a region of interest"),
    ("size", (HEIGHT // 2, WIDTH // 2), "is 8 x 6, .*camera_info says 4 x 3"),
    ("size", (WIDTH, HEIGHT), "is 8 x 6, .*camera_info says 6 x 8"),
    ("info_frame", "color", "camera_info is in frame 'color'"),
    ("encoding", "rgb8", "encoding = 'rgb8', expected"),
    ("encoding", "64FC1", "encoding = '64FC1', expected"),
    ("encoding", "", "encoding = '', expected"),
    ("data", np.zeros(3 * WIDTH, np.uint8), "24 bytes for 6 rows of 32"),
    ("step", 2 * WIDTH, "rows of 16"),
    *(("data", of_depth(depth), "no pixel has a depth of") for depth in (0.0, NAN, 750.0, 65.535, -0.75, np.inf)),
    ("is_bigendian", 1, r"median depth is 2\.3e-41 m, expected 0\.05 to 20 m: see encoding, unit, is_bigendian"),
    ("data", of_depth(0.75, ">f4"), "see encoding, unit, is_bigendian"),
    ("data", of_depth(0.0075), "median depth is 0.0075 m"),
    ("data", of_depth(28.0), "median depth is 28 m"),
]


@pytest.mark.parametrize(
    ("camera", "field", "value", "found"),
    [*((bridged, *case) for case in REFUSED), *((replayed, *case) for case in (*REFUSED[::6], REFUSED[-1]))],
)
def test_wrong_images_and_intrinsics_are_refused_at_the_start(
    camera: Camera, tmp_path: Path, field: str, value: Any, found: str
) -> None:
    seen = Seen()
    setattr(seen if hasattr(seen, field) else seen.image, field, value)
    with pytest.raises(UserError, match=found) as refused:
        camera(seen, tmp_path)
    assert "\n" not in str(refused.value)


FOREIGN = [
    link("world", "gripper", (0.0, 0.0, 0.0, 0.0)),
    link("map", "marker", (NAN,) * 4),
    link("gripper", "finger", p=(NAN, 0.0, 0.0)),
    link("world", "extrinsics", (0.0, 0.0, 0.0, 2.0)),
    link("world", "infinite", p=(0.0, np.inf, 0.0)),
    link("self", "self"),
    link("", "nameless"),
]


@pytest.mark.parametrize("camera", [bridged, replayed])
def test_a_foreign_transform_that_is_not_needed_is_left_out_and_named(
    camera: Camera, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    seen = Seen()
    seen.transforms = [*FOREIGN, *seen.transforms]
    service = camera(seen, tmp_path)
    (pose,) = service.start()[POSE].transforms  # type: ignore[union-attr]
    assert (pose.header.frame_id, pose.child_frame_id, pose.transform) == ("world", FRAME, seen.transforms[-1].transform)
    assert set(service.finish()["transforms_left_out"]) == {item.child_frame_id for item in FOREIGN}
    assert all(item.child_frame_id in caplog.text for item in FOREIGN)


BROKEN = [
    ([link("world", FRAME, (0.0, 0.0, 0.0, 0.0))], "needs that of 'camera_depth_optical_frame': orientation .* norm 0"),
    ([link("world", FRAME, (0.0, 0.0, 0.0, 1.5))], "norm 1.5"),
    ([link("world", "stand", (NAN,) * 4), link("stand", FRAME)], "needs that of 'stand': orientation"),
    ([link("world", FRAME, p=(NAN, 0.0, 0.0))], "translation"),
    ([link("map", FRAME)], "no way from 'world'.*map -> camera_depth_optical_frame"),
    ([link("world", "other_optical_frame")], "no way from 'world'.*world -> other_optical_frame"),
    ([link("a", FRAME), link(FRAME, "a")], "no way from 'world'"),
    ([], "no way from 'world'.*has nothing"),
]


@pytest.mark.parametrize(
    ("camera", "transforms", "found"), [*((bridged, *case) for case in BROKEN), (replayed, *BROKEN[0]), (replayed, *BROKEN[4])]
)
def test_a_broken_chain_is_refused_with_the_frame(camera: Camera, tmp_path: Path, transforms: list[Any], found: str) -> None:
    seen = Seen()
    seen.transforms = transforms
    with pytest.raises(UserError, match=found):
        camera(seen, tmp_path)


CHAINS = [
    [link("/world", f"/{FRAME}")],
    [link("world", FRAME, (0.0, 0.0, 0.0, 0.0)), link("world", FRAME)],
    [link("world", FRAME), link("world", FRAME, (NAN,) * 4)],
    [link("map", FRAME), link("world", FRAME)],
    [link("world", "link"), link("link", FRAME, UNIT, (0.0, 0.0, 0.0))],
    [link("base", FRAME, UNIT, (0.0, 0.0, 0.0)), link("world", "stand", UNIT, (0.0, 0.0, 0.0)), link("stand", "base")],
]


@pytest.mark.parametrize(("camera", "transforms"), [*((bridged, chain) for chain in CHAINS), (replayed, CHAINS[1])])
def test_the_newest_valid_chain_is_the_pose(camera: Camera, tmp_path: Path, transforms: list[Any]) -> None:
    seen = Seen()
    seen.transforms = transforms
    (pose,) = camera(seen, tmp_path).start()[POSE].transforms  # type: ignore[union-attr]
    np.testing.assert_allclose(transform_matrix(pose.transform), transform_matrix(link("world", FRAME).transform), atol=1e-12)


def asked(frames: int) -> HandInbox:
    """Return an inbox with a trigger for this number of frames."""
    return HandInbox().put("planning/camera_trigger", msg.CameraTrigger(msg.header(0), frames))


def test_a_burst_is_passed_on_by_the_contract_and_old_frames_are_not() -> None:
    port = Port()
    service = RosCameraService(port)
    inbox = asked(2)
    port.waiting = [ros_image()]
    small = {SMALL_IMAGE, SMALL_INFO}
    assert set(service.step(0, inbox)) == small, "a whole one taken before the trigger"
    for k in (1, 2):
        t = k * 100_000_000
        port.waiting = [ros_image(), ros_image()]
        out = service.step(t, inbox)
        for name, message in out.items():
            assert violations(contract().topics[name], message) == []
            assert msg.nanoseconds(message.header.stamp) == t
        assert set(out) == {IMAGE, INFO} | small
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
    now = msg.nanoseconds(image.header.stamp) + age_ms * msg.MS
    service = RosCameraService(port, now=lambda: now)
    port.waiting = [image]
    (depth, info) = service.step(1000 * msg.MS, HandInbox()).values()
    assert msg.nanoseconds(depth.header.stamp) == msg.nanoseconds(info.header.stamp) == stamped_ms * msg.MS


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
    port = Port(info=info)
    port.rectified = rectified
    service = RosCameraService(port)
    inbox = asked(1)
    service.step(0, inbox)
    port.waiting = [ros_image()]
    return service.step(100_000_000, inbox).get(INFO)


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


def test_over_zenoh_as_rmw_zenoh_sends_it(tmp_path: Path) -> None:
    endpoint = f"unixsock-stream/{tmp_path}/ros.sock"
    node = RosNode("realsense", 0, BusOptions(listen=(endpoint,)))
    tf = node.publisher("tf_static", "tf2_msgs/msg/TFMessage", latched=True)
    tf.publish(msg.TFMessage(TREE))  # before anyone subscribes
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
        if IMAGE in out:
            break
    image = out[IMAGE]
    np.testing.assert_allclose(np.asarray(image.data).view("<f4").reshape(2, 3), METRES, atol=1e-3)
    node.close()


@pytest.mark.parametrize(
    ("info", "frame", "problem"),
    [
        (ros_info(d=0.1), FRAME, "rectified"),
        (replace(ros_info(), width=6, height=4), FRAME, "3 x 2, camera_info says 6 x 4"),
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
