"""A camera that shows a recording: it conforms, shows the recorded pixels at new stamps, and names what a recording lacks."""

import copy
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh

from palpate.check.rig import ReceivedMessage, RigSettings, ServiceRig
from palpate.check.suites import check
from palpate.check.suites.camera import plane
from palpate.perceive import perceive_recording, write
from palpate.run.roles import check_choices
from palpate_bus.contract import contract
from palpate_bus.mcap_records import RecordingError
from palpate_bus.messages import MS, CameraTrigger, header, nanoseconds, time_message
from palpate_bus.messages.codec import encode
from palpate_bus.recordings import open_recording
from palpate_camera.backends.kinect.service import create as create_camera
from palpate_camera.backends.replay import POSE, ReplayedCamera, create
from palpate_camera.messages import IMAGE, INFO, SMALL_IMAGE, SMALL_INFO
from palpate_models.scenario.load import load_scenario
from palpate_recorder.service import RecorderService

FRAMES = 4
SCENARIO = load_scenario("clean")


@pytest.fixture(scope="module")
def seen() -> dict[str, list[ReceivedMessage]]:
    """Return a burst of the simulated camera that looks at a level square, as the conformance suite puts it there."""
    rig = ServiceRig(create_camera(SCENARIO), RigSettings(SCENARIO))
    rig.send("planning/camera_trigger", CameraTrigger(header(0), FRAMES))
    rig.run(0.1 * FRAMES + 0.5, {"sim/surface": plane(np.array(SCENARIO.camera.look_at_m))})
    return rig.log


ALL = (IMAGE, INFO, POSE, SMALL_IMAGE, SMALL_INFO)


def record(folder: Path, log: dict[str, list[ReceivedMessage]], topics: tuple[str, ...] = ALL) -> Path:
    recorder = RecorderService(folder)
    rows = contract().topics
    for topic in topics:
        for received in log[topic]:
            recorder.record(rows[topic], encode(received.message, rows[topic].type), received.t, received.sequence)
    recorder.finish()
    return folder


@pytest.fixture(scope="module")
def recording(seen: dict[str, list[ReceivedMessage]], tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record(tmp_path_factory.mktemp("run") / "recording_mcap", seen)


def test_it_conforms_to_the_role_camera(recording: Path) -> None:
    report = check(ServiceRig(ReplayedCamera(open_recording(recording)), RigSettings(SCENARIO)))
    assert report.passed, [result for result in report.results if result.verdict == "failed"]


def test_it_shows_the_recorded_pixels_in_their_order_the_small_ones_unasked_and_goes_round(
    recording: Path, seen: dict[str, list[ReceivedMessage]]
) -> None:
    rig = ServiceRig(ReplayedCamera(open_recording(recording)), RigSettings(SCENARIO))
    rig.run(2.0, {})
    assert not rig.log[IMAGE], "nothing unasked"
    assert len(rig.log[SMALL_IMAGE]) == len(rig.log[SMALL_INFO]) >= 20
    for received, small in zip(rig.log[SMALL_IMAGE], seen[SMALL_IMAGE], strict=False):
        np.testing.assert_array_equal(received.message.data, small.message.data)
        assert nanoseconds(received.message.header.stamp) == received.t
    rig.send("planning/camera_trigger", CameraTrigger(header(rig.t), FRAMES + 1))
    shown = rig.run(1.0, {})
    recorded = [received.message for received in seen[IMAGE]]
    assert len(shown[IMAGE]) == len(shown[INFO]) == FRAMES + 1
    for received, info, then in zip(shown[IMAGE], shown[INFO], [*recorded, recorded[0]], strict=True):
        np.testing.assert_array_equal(received.message.data, then.data)
        assert nanoseconds(received.message.header.stamp) == nanoseconds(info.message.header.stamp) == received.t
        assert received.t >= 2000 * MS
    assert rig.last(POSE) == seen[POSE][-1].message


def test_a_recording_of_ros_pairs_by_the_headers_and_takes_all_poses(
    seen: dict[str, list[ReceivedMessage]], tmp_path: Path
) -> None:
    """It has the time of reception, which is another one for each message, and a tf_static of each sender."""
    (pose,) = seen[POSE]
    stranger = copy.deepcopy(pose.message)
    stranger.transforms[0].child_frame_id = "gripper"
    late = [received._replace(t=received.t + 120_000) for received in seen[INFO]]
    poses = [pose._replace(message=stranger), pose._replace(t=pose.t + 1, sequence=pose.sequence + 1)]
    folder = record(tmp_path / "recording_mcap", {**seen, INFO: late, POSE: poses})
    camera = ReplayedCamera(open_recording(folder))
    assert camera.start()[POSE] == pose.message
    assert camera.finish()["frames_recorded"] == FRAMES


def test_perception_alone_sees_the_recorded_surface(recording: Path, tmp_path: Path) -> None:
    scenario = load_scenario("clean", ["exam.region_m=[0.1,0.1]"])
    found = perceive_recording(ReplayedCamera(open_recording(recording)), scenario)
    figures = write(tmp_path, found, scenario)
    mesh = trimesh.load(tmp_path / "surface.ply", process=False)
    height = SCENARIO.camera.look_at_m[2] - SCENARIO.exam.pose.xyz_m[2]
    np.testing.assert_allclose(mesh.vertices[:, 2], height, atol=0.008)  # of a camera with an error of calibration
    assert mesh.vertex_normals[:, 2].min() > 0.99
    assert figures["frames"] == FRAMES
    assert figures["coverage"] > 0.95
    assert (tmp_path / "surface.png").stat().st_size > 10_000


def restamped(received: list[ReceivedMessage], stamp: Callable[[int], int]) -> list[ReceivedMessage]:
    """Return messages with other stamps in their headers, by their time [ns]; they were logged in steps of 100 ms."""
    changed = copy.deepcopy(received)
    for message in changed:
        message.message.header.stamp = time_message(stamp(message.t))
    return changed


@pytest.mark.parametrize(
    ("image_stamp", "info_stamp"),
    [
        (lambda _: 0, lambda _: 0),
        (lambda _: 5, lambda t: t),
        (lambda t: t, lambda _: 0),
        (lambda t: t, lambda t: t + 137),
        (lambda t: t - t % (200 * MS), lambda t: t - t % (200 * MS)),
        (lambda t: t - t % (200 * MS), lambda t: t),
    ],
)
def test_images_whose_stamps_repeat_or_are_not_those_of_their_intrinsics_are_all_shown(
    seen: dict[str, list[ReceivedMessage]], tmp_path: Path, image_stamp: Callable[[int], int], info_stamp: Callable[[int], int]
) -> None:
    images, infos = restamped(seen[IMAGE], image_stamp), restamped(seen[INFO], info_stamp)
    folder = record(tmp_path / "recording_mcap", {**seen, IMAGE: images, INFO: infos})
    rig = ServiceRig(ReplayedCamera(open_recording(folder)), RigSettings(SCENARIO))
    rig.send("planning/camera_trigger", CameraTrigger(header(0), FRAMES))
    shown = rig.run(1.0, {})[IMAGE]
    assert len(shown) == FRAMES
    for received, then in zip(shown, seen[IMAGE], strict=True):
        np.testing.assert_array_equal(received.message.data, then.message.data)


def test_one_camera_info_is_that_of_all_images_and_a_message_recorded_twice_counts_once(
    seen: dict[str, list[ReceivedMessage]], tmp_path: Path
) -> None:
    twice = [one for received in seen[IMAGE] for one in (received, received._replace(t=received.t + 1))]
    folder = record(tmp_path / "recording_mcap", {**seen, IMAGE: twice, INFO: seen[INFO][:1]})
    assert ReplayedCamera(open_recording(folder)).finish()["frames_recorded"] == FRAMES


def test_intrinsics_that_change_are_refused(seen: dict[str, list[ReceivedMessage]], tmp_path: Path) -> None:
    infos = copy.deepcopy(seen[INFO])
    infos[-1].message.k[0] *= 1.1
    folder = record(tmp_path / "recording_mcap", {**seen, INFO: infos})
    with pytest.raises(RecordingError, match="intrinsics change"):
        ReplayedCamera(open_recording(folder))


def test_a_recording_without_small_images_has_those_of_its_whole_ones(
    seen: dict[str, list[ReceivedMessage]], tmp_path: Path
) -> None:
    folder = record(tmp_path / "recording_mcap", seen, (IMAGE, INFO, POSE))
    shown = ServiceRig(ReplayedCamera(open_recording(folder)), RigSettings(SCENARIO)).run(0.5, {})
    whole = np.frombuffer(seen[IMAGE][0].message.data, "<f4").reshape(480, 640)
    small = shown[SMALL_IMAGE][0].message
    np.testing.assert_array_equal(np.frombuffer(small.data, "<f4").reshape(small.height, small.width), whole[3::7, 3::7])
    assert shown[SMALL_INFO][0].message.k.tolist() == pytest.approx(seen[SMALL_INFO][0].message.k.tolist())


def test_a_recording_without_a_pose_is_refused_by_name(seen: dict[str, list[ReceivedMessage]], tmp_path: Path) -> None:
    folder = record(tmp_path / "recording_mcap", seen, (IMAGE, INFO))
    with pytest.raises(RecordingError, match="no message of tf_static"):
        ReplayedCamera(open_recording(folder))


def test_a_run_checks_the_recording_before_anything_starts(tmp_path: Path) -> None:
    (tmp_path / "bag_0.db3").write_bytes(b"SQLite format 3\0" + bytes(99))
    changed = {
        "camera": SCENARIO.camera.model_copy(update={"recording": str(tmp_path)}),
        "services": SCENARIO.services.model_copy(update={"camera": "replay"}),
    }
    with pytest.raises(RecordingError, match=r"camera\.recording"):
        create(SCENARIO)
    with pytest.raises(RecordingError, match="SQLite bag"):
        check_choices(SCENARIO.model_copy(update=changed))
