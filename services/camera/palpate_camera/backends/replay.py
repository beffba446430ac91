"""The camera as a service that plays a recording: a trigger returns the recorded frames in order, one per tick.

Small images are played in order, one per tick, without a trigger; a recording without small images uses its full-size ones.

The recording is an endless loop: a burst continues where the last one stopped, and the first frame follows the last. Each message
is stamped with the tick at which it is sent. The camera pose is that of the recording (`tf_static`).
"""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from operator import attrgetter
from pathlib import Path
from typing import Any, ClassVar, Final, NamedTuple

from palpate_bus.contract import contract
from palpate_bus.mcap_records import RecordingError
from palpate_bus.messages import CodecError, Message, TFMessage, TransformStamped, header, nanoseconds
from palpate_bus.messages.codec import decode
from palpate_bus.messages.geometry import transform_matrix
from palpate_bus.recordings import RecordedMessage, Recording, open_recording
from palpate_bus.service import Inbox, Outbox, Service
from palpate_camera import messages
from palpate_camera.messages import FRAME, IMAGE, INFO, SMALL_IMAGE, SMALL_INFO, CameraError, CameraInput, Frame, StaticTransforms
from palpate_errors import restate
from palpate_models.numerics.frames import Array
from palpate_models.scenario.schema import Scenario

POSE: Final = "tf_static"
WORLD: Final = "world"


class ReplayedCamera(Service):
    """Publishes the images of a recording."""

    role: ClassVar[str] = "camera"

    def __init__(self, recording: Recording, whole: bool = True) -> None:
        """Read and check the frames, about 1 MB each; with `whole`, all must have been kept.

        Raises RecordingError without a usable frame whose camera pose is known.
        """
        recorded: dict[str, list[RecordedMessage]] = {topic: [] for topic in (IMAGE, INFO, SMALL_IMAGE, SMALL_INFO, POSE)}
        recording.check(contract(), recorded, whole=whole)
        for message in recording.messages(recorded):
            recorded[message.topic].append(message)
        for topic in (IMAGE, INFO, POSE):
            if not recorded[topic]:
                raise RecordingError(f"{recording.path}: has no message of {topic}; a camera can be replayed only from all of "
                                     f"{IMAGE}, {INFO}, {POSE}")  # fmt: skip
        self._transforms = StaticTransforms()
        with restate((CameraError, CodecError), RecordingError, recording.path):
            for pose in _decode(recorded[POSE], contract().topics[POSE].type):  # each sender of a system publishes its own
                self._transforms.add(pose.message.transforms)
            first = decode(recorded[IMAGE][0].payload, contract().topics[IMAGE].type)
            frame = first.header.frame_id.lstrip("/")
            self._pose = self._transforms.need(WORLD, frame)
            self.frames = _frames(recorded, IMAGE, INFO, frame)
            self._small = _frames(recorded, SMALL_IMAGE, SMALL_INFO, frame)
        self._path = recording.path
        self._wanted = 0
        self._shown = self._ticks = 0

    @property
    def X_WC(self) -> Array:
        """Recorded pose of the optical frame in world, shape (4, 4)."""
        return transform_matrix(self._pose)

    def start(self) -> Outbox:
        """Return the recorded pose X_WC of the optical frame in world, latched."""
        return {POSE: TFMessage([TransformStamped(header(0, WORLD), FRAME, self._pose)])}

    def step(self, t: int, inbox: Inbox) -> Outbox:
        """Return the next small image, and during a burst the next whole one. A new trigger replaces the present burst."""
        for trigger in inbox.new("planning/camera_trigger"):
            self._wanted = int(trigger.frames)
        outbox = self._next_small(t)
        self._ticks += 1
        if self._wanted:
            outbox |= messages.whole_image(t, *self.frames[self._shown % len(self.frames)])
            self._wanted -= 1
            self._shown += 1
        return outbox

    def finish(self) -> Mapping[str, Any]:
        """Return the recording, the numbers of frames played and recorded, and the transforms left out."""
        return {
            "recording": str(self._path),
            "frames": self._shown,
            "frames_recorded": len(self.frames),
            "transforms_left_out": self._transforms.left_out,
        }

    def _next_small(self, t: int) -> dict[str, Message]:
        if self._small:
            return messages.small(t, *self._small[self._ticks % len(self._small)])
        return messages.small_of(t, *self.frames[self._ticks % len(self.frames)])


class _Logged(NamedTuple):
    """A decoded message."""

    time: int
    """Log time of the recording [ns]."""
    message: Message

    @property
    def stamp(self) -> int:
        """Stamp in the header [ns]."""
        return nanoseconds(self.message.header.stamp)


def _decode(recorded: Sequence[RecordedMessage], kind: str) -> Iterator[_Logged]:
    """Decode messages of the type `kind`; of equal payloads only one is kept. Raises CodecError."""
    once = {message.payload: message for message in recorded}
    return (_Logged(message.stamp, decode(message.payload, kind)) for message in once.values())


def _nearest(infos: Sequence[_Logged], time: int) -> _Logged:
    """Return the message logged nearest to `time` [ns]."""
    return min(infos, key=lambda info: abs(info.time - time))


def _pairs(images: Sequence[_Logged], infos: Sequence[_Logged]) -> Iterator[tuple[Message, Message]]:
    """Pair images, in order of stamps, with the intrinsics of that stamp; with those logged nearest if it has none or several."""
    counts = Counter(info.stamp for info in infos)
    by_stamp = {info.stamp: info for info in infos if counts[info.stamp] == 1}
    for image in sorted(images, key=attrgetter("stamp")):  # equal stamps stay in the order of the log
        info = by_stamp.get(image.stamp) or _nearest(infos, image.time)
        yield image.message, info.message


def _frames(recorded: Mapping[str, list[RecordedMessage]], image: str, info: str, frame: str) -> list[Frame]:
    """Return the images of a pair of topics with their intrinsics; none if one topic is empty. Raises CameraError, CodecError."""
    types = contract().topics
    images, infos = (list(_decode(recorded[topic], types[topic].type)) for topic in (image, info))
    source = CameraInput(
        image=image,
        info=info,
        frame=frame,
        other_frame="images, intrinsics and pose must be of one frame",
        distorted=f"record that as {image}, with d = 0",
    )
    frames = [source.read(*pair) for pair in _pairs(images, infos)] if infos else []
    if frames:
        source.check_seen(frames)
    if len(sizes := {frame.pinhole for frame in frames}) > 1:
        first, second = list(sizes)[:2]
        raise CameraError(f"{info}: intrinsics change within the recording: {first} and {second}; record one mode of the camera")
    return frames


def create(scenario: Scenario) -> ReplayedCamera:
    """Return the camera that plays `camera.recording`. Raises RecordingError."""
    path = scenario.camera.recording
    if path is None:
        raise RecordingError("services.camera: replay needs camera.recording: a run's folder, a rosbag2 folder or an .mcap file")
    return ReplayedCamera(open_recording(Path(path)))
