"""Images, intrinsics and transforms of other cameras: the recording and the ROS bridge accept and refuse the same ones."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from palpate_bus.contract import contract
from palpate_bus.messages import (
    MS,
    CameraTrigger,
    Image,
    Quaternion,
    RegionOfInterest,
    TFMessage,
    Transform,
    TransformStamped,
    Vector3,
    header,
)
from palpate_bus.messages.codec import encode
from palpate_bus.messages.geometry import camera_info, transform_matrix
from palpate_bus.recordings import open_recording
from palpate_bus.service import Service
from palpate_bus.testing import HandInbox
from palpate_camera.backends.replay import POSE, ReplayedCamera
from palpate_camera.backends.ros import CameraPort, RosCameraService
from palpate_camera.messages import FRAME, IMAGE, INFO
from palpate_errors import UserError
from palpate_recorder.service import RecorderService

WIDTH, HEIGHT = 8, 6
UNIT, HALF = (0.0, 0.0, 0.0, 1.0), (0.5, -0.5, 0.5, -0.5)
NAN = float("nan")


def link(parent: str, child: str, q: tuple[float, ...] = HALF, p: tuple[float, ...] = (0.1, 0.2, 0.3)) -> Any:
    return TransformStamped(header(0, parent), child, Transform(Vector3(*p), Quaternion(*q)))


class Seen:
    """Messages of a good camera, for a test to change."""

    def __init__(self) -> None:
        depth = np.full((HEIGHT, WIDTH), 0.75, "<f4")
        self.image = Image(header(5, FRAME), HEIGHT, WIDTH, "32FC1", 0, 4 * WIDTH, depth.view(np.uint8).ravel())
        self.k = np.array([600.0, 0, 3.5, 0, 610.0, 2.5, 0, 0, 1])
        self.d = np.zeros(5)
        self.size = (HEIGHT, WIDTH)
        self.info_frame = FRAME
        self.binning_x = 0
        self.roi = RegionOfInterest(0, 0, 0, 0, False)
        self.transforms = [link("world", FRAME)]

    @property
    def info(self) -> Any:
        plain = camera_info(header(5, self.info_frame), self.size, self.k.reshape(3, 3))
        return replace(plain, d=self.d, binning_x=self.binning_x, roi=self.roi)


class Port(CameraPort):
    def __init__(self, seen: Seen) -> None:
        self.seen = seen

    def images(self) -> list[Any]:
        self.seen.image.header.stamp.nanosec += 1
        return [self.seen.image]

    def info(self) -> Any:
        return self.seen.info

    def transforms(self) -> list[Any]:
        return self.seen.transforms


def bridged(seen: Seen, _: Path) -> Service:
    return RosCameraService(Port(seen), wait_s=0.0)


def replayed(seen: Seen, folder: Path) -> Service:
    recorder = RecorderService(folder)
    for topic, message in ((IMAGE, seen.image), (INFO, seen.info), (POSE, TFMessage(seen.transforms))):
        row = contract().topics[topic]
        recorder.record(row, encode(message, row.type), 5 * MS, 1)
    recorder.finish()
    return ReplayedCamera(open_recording(folder))


both = pytest.mark.parametrize("camera", [bridged, replayed])
Camera = Callable[[Seen, Path], Service]


def shown(service: Service) -> Any:
    """Return the whole image that a trigger gives."""
    inbox = HandInbox().put("planning/camera_trigger", CameraTrigger(header(0), 1))
    return service.step(0, inbox).get(IMAGE) or service.step(100 * MS, HandInbox())[IMAGE]


@both
@pytest.mark.parametrize(
    ("field", "value", "found"),
    [
        *(
            ("d", np.array(d), r"d = \[.*rectify")
            for d in ([0.12, 0, 0, 0, 0], [NAN] * 5, [-0.3, 0.1, 0, 0, 0, 0.01, 0.02, 0.03])
        ),
        *(
            ("k", np.array([fx, 0, cx, 0, fy, cy, 0, 0, 1.0]), "k = ")
            for fx, fy, cx, cy in (
                (NAN, 600.0, 3.5, 2.5),
                (-600.0, 600.0, 3.5, 2.5),
                (600.0, 600.0, NAN, 2.5),
                (0.09, 0.11, 0.5, 0.5),  # as shares of the image
                (600.0, 600.0, 319.5, 239.5),  # of another resolution
                (600.0, 600.0, 1.5, 1.0),
                (600.0, 200.0, 3.5, 2.5),
                (1e7, 1e7, 3.5, 2.5),
            )
        ),
        ("k", np.array([600.0, 3.0, 3.5, 0.0, 600.0, 2.5, 0.0, 0.0, 1.0]), "k = .*expected fx, 0, cx"),
        ("k", np.array([600.0, 0.0, 3.5, 0.0, 600.0, 2.5, 0.0, 0.0, 2.0]), "k = .*expected fx, 0, cx"),
        ("binning_x", 2, "binning or a region of interest"),
        ("roi", RegionOfInterest(0, 1, HEIGHT // 2, WIDTH // 2, False), "binning or a region of interest"),
        ("k", np.eye(3).ravel(), r"k = .*principal point|k = .*focal"),
        ("size", (HEIGHT // 2, WIDTH // 2), "is 8 x 6, .*camera_info says 4 x 3"),
        ("size", (WIDTH, HEIGHT), "is 8 x 6, .*camera_info says 6 x 8"),
        ("info_frame", "color", "camera_info is in frame 'color'"),
    ],
)
def test_wrong_intrinsics_are_refused_at_the_start(camera: Camera, tmp_path: Path, field: str, value: Any, found: str) -> None:
    seen = Seen()
    setattr(seen, field, value)
    with pytest.raises(UserError, match=found) as refused:
        camera(seen, tmp_path / "recording_mcap")
    assert "\n" not in str(refused.value)


@both
@pytest.mark.parametrize(
    ("field", "value", "found"),
    [
        ("encoding", "rgb8", "encoding = 'rgb8', expected"),
        ("encoding", "64FC1", "encoding = '64FC1', expected"),
        ("encoding", "", "encoding = '', expected"),
        ("data", np.zeros(3 * WIDTH, np.uint8), "24 bytes for 6 rows of 32"),
        ("step", 2 * WIDTH, "rows of 16"),
        *(
            ("data", np.full(WIDTH * HEIGHT, depth, "<f4").view(np.uint8), "no pixel has a depth of 0 to 65.5 m")
            for depth in (0.0, NAN, 750.0, 65.535, -0.75, np.inf)
        ),
        ("is_bigendian", 1, r"median depth is 2\.3e-41 m, expected 0\.05 to 20 m: see encoding, unit, is_bigendian"),
        ("data", np.full(WIDTH * HEIGHT, 0.75, ">f4").view(np.uint8), "see encoding, unit, is_bigendian"),
        ("data", np.full(WIDTH * HEIGHT, 0.0075, "<f4").view(np.uint8), "median depth is 0.0075 m"),
        ("data", np.full(WIDTH * HEIGHT, 28.0, "<f4").view(np.uint8), "median depth is 28 m"),
    ],
)
def test_wrong_images_are_refused_at_the_start(camera: Camera, tmp_path: Path, field: str, value: Any, found: str) -> None:
    seen = Seen()
    setattr(seen.image, field, value)
    with pytest.raises(UserError, match=found):
        camera(seen, tmp_path / "recording_mcap")


FOREIGN = [
    link("world", "gripper", (0.0, 0.0, 0.0, 0.0)),
    link("map", "marker", (NAN,) * 4),
    link("gripper", "finger", p=(NAN, 0.0, 0.0)),
    link("world", "extrinsics", (0.0, 0.0, 0.0, 2.0)),
    link("world", "infinite", p=(0.0, np.inf, 0.0)),
    link("self", "self"),
    link("", "nameless"),
]


@both
@pytest.mark.parametrize("item", FOREIGN, ids=lambda item: item.child_frame_id)
def test_a_foreign_transform_that_is_not_needed_is_left_out_and_named(
    camera: Camera, tmp_path: Path, item: Any, caplog: pytest.LogCaptureFixture
) -> None:
    seen = Seen()
    seen.transforms = [item, *seen.transforms]
    service = camera(seen, tmp_path / "recording_mcap")
    (pose,) = service.start()[POSE].transforms
    assert (pose.header.frame_id, pose.child_frame_id, pose.transform) == ("world", FRAME, seen.transforms[-1].transform)
    assert list(service.finish()["transforms_left_out"]) == [item.child_frame_id]
    assert item.child_frame_id in caplog.text


@both
@pytest.mark.parametrize(
    ("transforms", "found"),
    [
        ([link("world", FRAME, (0.0, 0.0, 0.0, 0.0))], "needs that of 'camera_depth_optical_frame': orientation .* norm 0"),
        ([link("world", FRAME, (0.0, 0.0, 0.0, 1.5))], "norm 1.5"),
        ([link("world", "stand", (NAN,) * 4), link("stand", FRAME)], "needs that of 'stand': orientation"),
        ([link("world", FRAME, p=(NAN, 0.0, 0.0))], "translation"),
        ([link("map", FRAME)], "no way from 'world'.*map -> camera_depth_optical_frame"),
        ([link("world", "other_optical_frame")], "no way from 'world'.*world -> other_optical_frame"),
        ([link("a", FRAME), link(FRAME, "a")], "no way from 'world'"),
        ([], "no way from 'world'.*has nothing"),
    ],
)
def test_a_broken_chain_is_refused_with_the_frame(camera: Camera, tmp_path: Path, transforms: list[Any], found: str) -> None:
    seen = Seen()
    seen.transforms = transforms
    with pytest.raises(UserError, match=found):
        camera(seen, tmp_path / "recording_mcap")


@both
@pytest.mark.parametrize(
    "transforms",
    [
        [link("/world", f"/{FRAME}")],
        [link("world", FRAME, (0.0, 0.0, 0.0, 0.0)), link("world", FRAME)],
        [link("world", FRAME), link("world", FRAME, (NAN,) * 4)],
        [link("map", FRAME), link("world", FRAME)],
        [link("world", "link"), link("link", FRAME, UNIT, (0.0, 0.0, 0.0))],
        [link("base", FRAME, UNIT, (0.0, 0.0, 0.0)), link("world", "stand", UNIT, (0.0, 0.0, 0.0)), link("stand", "base")],
    ],
)
def test_the_newest_valid_chain_is_the_pose(camera: Camera, tmp_path: Path, transforms: list[Any]) -> None:
    seen = Seen()
    seen.transforms = transforms
    (pose,) = camera(seen, tmp_path / "recording_mcap").start()[POSE].transforms
    np.testing.assert_allclose(transform_matrix(pose.transform), transform_matrix(link("world", FRAME).transform), atol=1e-12)
