"""Perception as a service: fuses the frames that follow a trigger, publishes what they show, and follows the wall."""

from collections.abc import Mapping
from typing import Any, ClassVar, Final, NamedTuple

import numpy as np

from palpate_bus.contract import contract
from palpate_bus.messages import NS, Message, PalpationTargets, SurfaceCorrection, SurfaceMotion, geometry, header, nanoseconds
from palpate_bus.messages.codes import ViewReason
from palpate_bus.service import Inbox, Outbox, Service
from palpate_models.numerics.frames import apply, inverse
from palpate_models.scenario.load import exam_input
from palpate_models.scenario.schema import ExamInput, Scenario
from palpate_perception.cloud import Cloud, DepthFusion, Intrinsics
from palpate_perception.follower import WATCH, Follower
from palpate_perception.pipeline import Perceived, Pipeline, Targets
from palpate_perception.wall import BreathingMode

IMAGE: Final = "camera/depth/image_raw"
FRAME: Final = contract().topics["perception/targets"].frame or ""
"""Frame of the surface and the targets."""
MOTION_FRAME: Final = contract().topics["perception/motion"].frame or ""


class PerceptionTimes(NamedTuple):
    """Times of the service."""

    correction_period_ns: int = 5 * NS
    """Period of surface corrections [ns]."""
    frame_wait_ns: int = 1 * NS
    """Wait for missing frames after the expected end of a burst [ns]."""


TIMES: Final = PerceptionTimes()


class PerceptionService(Service):
    """Publishes cloud, surface and targets for each burst of depth frames, and the wall's motion for each small image."""

    role: ClassVar[str] = "perception"

    def __init__(self, exam: ExamInput) -> None:
        X_WA = np.array(exam.X_WA)
        self._pipeline = Pipeline(exam.exam, X_WA)
        self._follower = Follower(exam.exam, X_WA, exam.robot)
        self._period = contract().topics[IMAGE].period
        self._burst: _Burst | None = None
        self._X_AW = inverse(X_WA)
        self._last: Perceived | None = None
        self._corrected = 0
        """Time of the last surface or correction [ns]."""
        self._bursts = 0

    def step(self, t: int, inbox: Inbox) -> Outbox:
        """Publish the wall's motion for each small image; start a scan on a trigger, and publish its surface when complete."""
        for trigger in inbox.new("planning/camera_trigger"):
            asked = nanoseconds(trigger.header.stamp)
            self._burst = _Burst(asked, int(trigger.frames), t + int(trigger.frames) * self._period + TIMES.frame_wait_ns)
            self._follower.begin(asked / NS)
            self._bursts += 1
        motions = [self._follow(image, inbox) for image in inbox.new("camera/follow/depth")]
        outbox: dict[str, Message | list[Message]] = {"perception/motion": motions} if motions else {}
        return outbox | self._correction(t) | self._answer(t, inbox)

    def _follow(self, image: Message, inbox: Inbox) -> Message:
        """Return the motion message of a small image."""
        stamp, status = nanoseconds(image.header.stamp), inbox.latest("robot/status")
        camera = _intrinsics(inbox, "camera/follow/camera_info", image)
        try:
            depth = geometry.depth_in_metres("camera/follow/depth", image)
        except ValueError:  # unknown encoding: ignore the image
            depth, camera = np.empty((0, 0), np.float32), None
        q = None if status is None or not len(status.position) else np.asarray(status.position, np.float64)
        wall = self._follower.take(stamp / NS, depth, camera, q)
        state, shift = getattr(SurfaceMotion, wall.state.name), geometry.vector_message(wall.shift)
        return SurfaceMotion(header(stamp, MOTION_FRAME), state, wall.displacement, wall.forecast, wall.sigma, shift)

    def _correction(self, t: int) -> dict[str, Message | list[Message]]:
        """Return the correction of the published surface by the mean of the images since, once per period."""
        last, average = self._last, self._follower.average
        if self._burst is not None or last is None or last.mesh is None or last.field is None or average is None:
            return {}
        if t < self._corrected + TIMES.correction_period_ns:
            return {}
        self._corrected = t
        outward = average.outward_of(last.field, self._X_AW)
        if outward is None:
            return {}
        x, y, _ = apply(self._X_AW, last.mesh.p_W).T
        offset = outward.height(x, y).astype(np.float32)
        return {"perception/correction": SurfaceCorrection(header(t, MOTION_FRAME), offset, np.empty(0, np.float32))}

    def _answer(self, t: int, inbox: Inbox) -> dict[str, Message | list[Message]]:
        """Return the messages of the current scan; empty until it is complete."""
        images = list(inbox.new(IMAGE))
        burst = self._burst
        if burst is None:
            return {}
        burst.waiting += [image for image in images if nanoseconds(image.header.stamp) >= burst.asked]
        self._fuse(burst, inbox)
        full = burst.fusion is not None and burst.fusion.frames >= burst.wanted
        watched = self._follower.watched or t >= burst.asked + WATCH.longest_s * NS + TIMES.frame_wait_ns
        given_up = bool(burst.wrong) or inbox.lost("camera") or (not full and watched and t >= burst.deadline)
        if not given_up and not (full and watched):
            return {}
        self._burst = None
        seen = self._follower.end()
        if burst.wrong or burst.fusion is None or burst.camera is None:
            return {"perception/targets": targets(t, _nothing(burst, inbox))}
        mode: BreathingMode | None = None
        if seen is not None:
            wall, times, d = seen
            displacements = np.interp(burst.stamps_s, times, d)
            burst.fusion.level(displacements, wall.depth_per_metre(burst.camera, burst.fusion.window))
            mode = wall.mode
        perceived = self._pipeline.perceive(burst.fusion, burst.camera, mode, self._follower.shift)
        self._last, self._corrected = perceived, t
        outbox: dict[str, Message | list[Message]] = {
            "perception/points": geometry.cloud_message(header(t, FRAME), perceived.cloud.p_W),
            "perception/targets": targets(t, perceived),
        }
        if perceived.mesh is not None:
            mesh = perceived.mesh
            outbox["perception/surface"] = geometry.mesh_message(header(t, FRAME), mesh.p_W, mesh.n_W, mesh.triangles, mesh.lifts)
        return outbox

    def finish(self) -> Mapping[str, Any]:
        """Return the result of the last burst, and statistics of the wall's motion."""
        followed: dict[str, Any] = {"bursts": self._bursts, "followed": self._follower.counts}
        if self._last is None:
            return followed
        return {
            **followed,
            "frames_fused": self._last.frames,
            "coverage": self._last.coverage,
            "surface_noise_m": self._last.sigma,
            "targets": len(self._last.targets.p_W),
        }

    def _fuse(self, burst: "_Burst", inbox: Inbox) -> None:
        """Add the waiting frames once intrinsics and pose are known; over a network they may arrive later."""
        if not burst.waiting:
            return
        if burst.camera is None:
            burst.camera = _intrinsics(inbox, "camera/depth/camera_info", burst.waiting[0])
            if burst.camera is None:
                return
            burst.fusion = self._pipeline.fusion(burst.camera)
        if burst.fusion is not None:
            for image in burst.waiting[: burst.wanted - burst.fusion.frames]:
                height, width = burst.camera.shape
                if (image.height, image.width) != (height, width) and not burst.wrong:
                    burst.wrong = f"depth image is {image.width} x {image.height}, camera_info says {width} x {height}"
                if burst.wrong:
                    continue
                try:
                    depth = geometry.depth_in_metres(IMAGE, image)
                except ValueError as error:  # of another encoding, or too few bytes
                    burst.wrong = str(error)
                    continue
                burst.fusion.add(depth)
                burst.stamps_s.append(nanoseconds(image.header.stamp) / NS)
            burst.waiting.clear()


class _Burst:
    """A burst that is under way."""

    def __init__(self, asked: int, wanted: int, deadline: int) -> None:
        """Times in ns; `wanted` frames."""
        self.asked, self.wanted, self.deadline = asked, wanted, deadline
        self.waiting: list[Message] = []
        self.camera: Intrinsics | None = None
        self.fusion: DepthFusion | None = None
        self.stamps_s: list[float] = []
        """When the fused frames were exposed [s]."""
        self.wrong = ""
        """Description of the defect of its frames; empty if they are valid."""


def create(scenario: Scenario) -> Service:
    """Perception of a scenario; it knows nothing of the phantom but where the patient is registered."""
    return PerceptionService(exam_input(scenario))


def _intrinsics(inbox: Inbox, topic: str, image: Message) -> Intrinsics | None:
    """Return intrinsics and pose for an image, from the newest camera_info on `topic` and tf_static; None until both arrived.

    Raises ValueError for a quaternion that is not of unit length.
    """
    info, pose = inbox.latest(topic), inbox.latest("tf_static")
    X_WC = None if pose is None else geometry.pose_of_frame(pose, image.header.frame_id, FRAME)
    if info is None or X_WC is None:
        return None
    return Intrinsics(np.array(info.k, np.float64).reshape(3, 3), X_WC, (int(info.height), int(info.width)))


def _nothing(burst: _Burst, inbox: Inbox) -> Perceived:
    """Return the answer to a burst of which no frame could be used."""
    if burst.wrong:
        reason, text = ViewReason.BAD_FRAMES, burst.wrong
    elif inbox.lost("camera"):
        reason, text = ViewReason.NO_CAMERA, "the camera service has left the run"
    elif burst.waiting and inbox.latest("tf_static") is None:
        reason, text = ViewReason.NO_CALIBRATION, "frames received, but no tf_static with the camera's pose"
    elif burst.waiting:
        reason, frame = ViewReason.NO_CALIBRATION, burst.waiting[0].header.frame_id
        text = f"frames received, but no camera/depth/camera_info or no pose of {frame!r} in world"
    else:
        reason = ViewReason.NO_FRAMES
        text = f"no frame on camera/depth/image_raw within {TIMES.frame_wait_ns / NS:.0f} s of the expected end of the burst"
    empty = Cloud(np.empty((0, 3)), np.empty(0), np.empty((0, 2), np.intp))
    return Perceived(empty, None, Targets.none(), 0.0, 0, 0.0, reason, f"no surface: {text}")


def targets(t: int, perceived: Perceived) -> Message:
    """Return `palpation_msgs/PalpationTargets` in world."""
    found = perceived.targets
    points, normals = [geometry.point_message(p) for p in found.p_W], [geometry.vector_message(n) for n in found.n_W]
    facts = (perceived.sigma, perceived.frames, perceived.coverage, perceived.reason, perceived.message)
    return PalpationTargets(header(t, FRAME), points, normals, found.line, *facts)
