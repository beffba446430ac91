"""The camera as a service that plays a recording: a trigger gets the recorded frames in their order, one a tick.

The recording is a tape without an end: a new burst goes on where the last one stopped, and after the last frame comes the first.
Every message is stamped anew, with the tick that it is sent at. The pose of the camera is the recording's too (`tf_static`).
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

from palpate_bus.contract import contract
from palpate_bus.messages.codec import Message, decode
from palpate_bus.messages.stamps import time_message
from palpate_bus.recordings import RecordedMessage, Recording, RecordingError, open_recording
from palpate_bus.service import Inbox, Outbox, Service
from palpate_models.scenario import Scenario

IMAGE, INFO, POSE = "camera/depth/image_raw", "camera/depth/camera_info", "tf_static"


class ReplayedCamera(Service):
    """Shows what a camera saw before."""

    role: ClassVar[str] = "camera"

    def __init__(self, recording: Recording) -> None:
        """Reads the frames, about 1 MB each. Raises RecordingError when the recording has no frame or no pose."""
        rules = contract()
        recording.check(rules, (IMAGE, INFO, POSE))
        by_topic: dict[str, dict[int, RecordedMessage]] = {IMAGE: {}, INFO: {}, POSE: {}}
        for message in recording.messages(by_topic):
            by_topic[message.topic][message.stamp] = message
        for topic, messages in by_topic.items():
            if not messages:
                raise RecordingError(f"{recording.path}: has no message of {topic}; a camera can be replayed only from all of "
                                     f"{', '.join(by_topic)}")  # fmt: skip
        self._types = {topic: rules.topics[topic].type for topic in by_topic}
        self._pose = self._message(next(iter(by_topic[POSE].values())))
        self._frames = [(by_topic[IMAGE][t], by_topic[INFO][t]) for t in sorted(by_topic[IMAGE]) if t in by_topic[INFO]]
        if not self._frames:
            raise RecordingError(f"{recording.path}: no image has a camera_info of its stamp")
        self._path = recording.path
        self._wanted = 0
        self._shown = 0

    def start(self) -> Outbox:
        """The recorded pose of the optical frame in world, latched."""
        return {POSE: self._pose}

    def step(self, t: int, inbox: Inbox) -> Outbox:
        """The next frame with its intrinsics while a burst lasts; a new trigger replaces the burst that is under way."""
        for trigger in inbox.new("planning/camera_trigger"):
            self._wanted = int(trigger.frames)
        if self._wanted == 0:
            return {}
        image, info = (self._message(part) for part in self._frames[self._shown % len(self._frames)])
        self._wanted -= 1
        self._shown += 1
        image.header.stamp = info.header.stamp = time_message(t)
        return {IMAGE: image, INFO: info}

    def finish(self) -> Mapping[str, Any]:
        """How many frames were shown, and how many different ones there are."""
        return {"recording": str(self._path), "frames": self._shown, "frames_recorded": len(self._frames)}

    def _message(self, recorded: RecordedMessage) -> Message:
        return decode(recorded.payload, self._types[recorded.topic])


def create(scenario: Scenario) -> ReplayedCamera:
    """The camera of `camera.recording`. Raises RecordingError."""
    path = scenario.camera.recording
    if path is None:
        raise RecordingError("services.camera: replay needs camera.recording: a run's folder, a rosbag2 folder or an .mcap file")
    return ReplayedCamera(open_recording(Path(path)))
