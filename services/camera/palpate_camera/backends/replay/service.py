"""The camera as a service that plays a recording: a trigger returns the recorded frames in order, one per tick.

Small images are played in order, one per tick, without a trigger; a recording without small images uses its full-size ones.

The recording is an endless loop: a burst continues where the last one stopped, and the first frame follows the last. Each message
is stamped with the tick at which it is sent. The camera pose is that of the recording (`tf_static`).
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

from palpate_bus.contract import contract
from palpate_bus.messages.codec import Message, decode
from palpate_bus.messages.geometry import depth_in_metres
from palpate_bus.messages.stamps import nanoseconds, time_message
from palpate_bus.recordings import RecordedMessage, Recording, RecordingError, open_recording
from palpate_bus.service import Inbox, Outbox, Service
from palpate_camera import messages
from palpate_camera.messages import IMAGE, INFO, SMALL_IMAGE, SMALL_INFO
from palpate_models.scenario.schema import Scenario

POSE = "tf_static"
_Pair = tuple[RecordedMessage, RecordedMessage]


class ReplayedCamera(Service):
    """Shows what a camera saw before."""

    role: ClassVar[str] = "camera"

    def __init__(self, recording: Recording) -> None:
        """Reads the frames, about 1 MB each. Raises RecordingError when the recording has no frame or no pose."""
        rules = contract()
        by_topic: dict[str, dict[int, RecordedMessage]] = {topic: {} for topic in (IMAGE, INFO, SMALL_IMAGE, SMALL_INFO)}
        poses: list[RecordedMessage] = []
        self._types = {topic: rules.topics[topic].type for topic in (*by_topic, POSE)}
        recording.check(rules, self._types)
        for message in recording.messages(self._types):
            if message.topic == POSE:
                poses.append(message)
            else:  # by the header: a recording of ROS has the time at which each was received
                by_topic[message.topic][nanoseconds(self._message(message).header.stamp)] = message
        recorded = {**by_topic, POSE: poses}
        for topic in (IMAGE, INFO, POSE):
            if not recorded[topic]:
                raise RecordingError(f"{recording.path}: has no message of {topic}; a camera can be replayed only from all of "
                                     f"{IMAGE}, {INFO}, {POSE}")  # fmt: skip
        self._pose = self._message(poses[0])
        for message in poses[1:]:  # each sender of a system publishes its own
            self._pose.transforms.extend(self._message(message).transforms)
        self._frames = _pairs(by_topic[IMAGE], by_topic[INFO])
        if not self._frames:
            raise RecordingError(f"{recording.path}: no image has a camera_info of its stamp")
        self._small = _pairs(by_topic[SMALL_IMAGE], by_topic[SMALL_INFO])
        self._path = recording.path
        self._wanted = 0
        self._shown = self._ticks = 0

    def start(self) -> Outbox:
        """The recorded pose of the optical frame in world, latched."""
        return {POSE: self._pose}

    def step(self, t: int, inbox: Inbox) -> Outbox:
        """The next small image, and the next whole one while a burst lasts; a new trigger replaces the burst under way."""
        for trigger in inbox.new("planning/camera_trigger"):
            self._wanted = int(trigger.frames)
        outbox = self._next_small(t)
        self._ticks += 1
        if self._wanted:
            outbox |= self._pair(t, self._frames, self._shown, (IMAGE, INFO))
            self._wanted -= 1
            self._shown += 1
        return outbox

    def finish(self) -> Mapping[str, Any]:
        """Return the number of frames played, and of different ones."""
        return {"recording": str(self._path), "frames": self._shown, "frames_recorded": len(self._frames)}

    def _next_small(self, t: int) -> dict[str, Message]:
        if self._small:
            return self._pair(t, self._small, self._ticks, (SMALL_IMAGE, SMALL_INFO))
        image, info = self._pair(t, self._frames, self._ticks, (IMAGE, INFO)).values()
        return messages.every_few(t, depth_in_metres(IMAGE, image), messages.pinhole_of(info))

    def _pair(self, t: int, pairs: list[_Pair], index: int, topics: tuple[str, str]) -> dict[str, Message]:
        image, info = (self._message(part) for part in pairs[index % len(pairs)])
        image.header.stamp = info.header.stamp = time_message(t)
        return dict(zip(topics, (image, info), strict=True))

    def _message(self, recorded: RecordedMessage) -> Message:
        return decode(recorded.payload, self._types[recorded.topic])


def _pairs(images: Mapping[int, RecordedMessage], infos: Mapping[int, RecordedMessage]) -> list[_Pair]:
    """Images with the intrinsics of their stamp, in their order."""
    return [(images[t], infos[t]) for t in sorted(images) if t in infos]


def create(scenario: Scenario) -> ReplayedCamera:
    """The camera of `camera.recording`. Raises RecordingError."""
    path = scenario.camera.recording
    if path is None:
        raise RecordingError("services.camera: replay needs camera.recording: a run's folder, a rosbag2 folder or an .mcap file")
    return ReplayedCamera(open_recording(Path(path)))
