"""Perception as a service: fuses the frames that follow a trigger and publishes what they show."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, Final

import numpy as np

from palpate_bus.contract import contract
from palpate_bus.messages import PalpationTargets, Point, PointCloud2, PointField, SurfaceMesh, Vector3
from palpate_bus.messages.codec import Message
from palpate_bus.messages.geometry import transform_matrix
from palpate_bus.messages.stamps import NS, header, nanoseconds
from palpate_bus.service import Inbox, Outbox, Service
from palpate_models.frames import Array
from palpate_models.load import exam_input
from palpate_models.scenario import ExamInput, Scenario
from palpate_perception.cloud import Cloud
from palpate_perception.fusion import DepthFusion, Image
from palpate_perception.pipeline import Intrinsics, Perceived, PerceivedMesh, Pipeline, Targets

FRAME: Final = contract().topics["perception/targets"].frame or ""
"""Frame of all that perception sends."""
PATIENCE_NS: Final = 1 * NS
"""How long after the expected end of a burst perception waits for missing frames."""


class PerceptionService(Service):
    """One burst of depth frames in; one cloud, one surface and one list of targets out."""

    role: ClassVar[str] = "perception"

    def __init__(self, exam: ExamInput) -> None:
        self._pipeline = Pipeline(exam.exam, np.array(exam.X_WA))
        self._period = contract().topics["camera/depth/image_raw"].period
        self._burst: _Burst | None = None
        self._last: Perceived | None = None
        self._bursts = 0

    def step(self, t: int, inbox: Inbox) -> Outbox:
        """Starts a fusion on a trigger, adds the frames that are younger than it, and publishes once all are in."""
        for trigger in inbox.new("planning/camera_trigger"):
            asked = nanoseconds(trigger.header.stamp)
            self._burst = _Burst(asked, int(trigger.frames), t + int(trigger.frames) * self._period + PATIENCE_NS)
            self._bursts += 1
        frames = list(inbox.new("camera/depth/image_raw"))
        burst = self._burst
        if burst is None:
            return {}
        burst.waiting += [frame for frame in frames if nanoseconds(frame.header.stamp) >= burst.asked]
        self._fuse(burst, inbox)
        done = bool(burst.wrong) or (burst.fusion is not None and burst.fusion.frames >= burst.wanted)
        if not done and t < burst.deadline and not inbox.lost("camera"):
            return {}
        self._burst = None
        if burst.wrong or burst.fusion is None or burst.camera is None:
            return {"perception/targets": targets(t, _nothing(burst, inbox))}
        perceived = self._pipeline.perceive(burst.fusion, burst.camera)
        self._last = perceived
        outbox = {"perception/points": points(t, perceived.cloud.p_W), "perception/targets": targets(t, perceived)}
        if perceived.mesh is not None:
            outbox["perception/surface"] = surface(t, perceived.mesh)
        return outbox

    def finish(self) -> Mapping[str, Any]:
        """What the last burst showed."""
        if self._last is None:
            return {"bursts": self._bursts}
        return {
            "bursts": self._bursts,
            "frames_fused": self._last.frames,
            "coverage": self._last.coverage,
            "surface_noise_m": self._last.sigma,
            "targets": len(self._last.targets.p_W),
        }

    def _fuse(self, burst: _Burst, inbox: Inbox) -> None:
        """Adds the waiting frames, once intrinsics and pose are known (over a network they may arrive later)."""
        if not burst.waiting:
            return
        if burst.camera is None:
            info, pose = inbox.latest("camera/depth/camera_info"), inbox.latest("tf_static")
            X_WC = None if pose is None else camera_pose(pose, burst.waiting[0].header.frame_id)
            if info is None or X_WC is None:
                return
            K = np.array(info.k, np.float64).reshape(3, 3)
            burst.camera = Intrinsics(K, X_WC, (int(info.height), int(info.width)))
            burst.fusion = self._pipeline.fusion(burst.camera)
        if burst.fusion is not None:
            for frame in burst.waiting[: burst.wanted - burst.fusion.frames]:
                burst.wrong = burst.wrong or _disagreement(frame, burst.camera)
                if not burst.wrong:
                    burst.fusion.add(depth_in_metres(frame))
            burst.waiting.clear()


class _Burst:
    """A burst that is under way."""

    def __init__(self, asked: int, wanted: int, deadline: int) -> None:
        """Times in ns; `wanted` frames."""
        self.asked, self.wanted, self.deadline = asked, wanted, deadline
        self.waiting: list[Message] = []
        self.camera: Intrinsics | None = None
        self.fusion: DepthFusion | None = None
        self.wrong = ""
        """Why its frames cannot be used; empty while they can."""


def create(scenario: Scenario) -> Service:
    """Perception of a scenario; it knows nothing of the phantom but where the patient is registered."""
    return PerceptionService(exam_input(scenario))


def _disagreement(frame: Message, camera: Intrinsics) -> str:
    """Why the intrinsics cannot be those of a frame; empty when they can."""
    height, width = camera.shape
    if (frame.height, frame.width) == (height, width):
        return ""
    return f"depth image is {frame.width} x {frame.height}, camera_info says {width} x {height}"


def _nothing(burst: _Burst, inbox: Inbox) -> Perceived:
    """The answer to a burst of which nothing could be used."""
    if burst.wrong:
        why = burst.wrong
    elif inbox.lost("camera"):
        why = "the camera's service is gone"
    elif burst.waiting and inbox.latest("tf_static") is None:
        why = "frames came, but no tf_static with the camera's pose"
    elif burst.waiting:
        why = f"frames came, but no camera/depth/camera_info or no pose of {burst.waiting[0].header.frame_id!r} in world"
    else:
        why = f"no frame on camera/depth/image_raw within {PATIENCE_NS / NS:.0f} s of the expected end of the burst"
    empty = Cloud(np.empty((0, 3)), np.empty(0), np.empty((0, 2), np.intp))
    return Perceived(empty, None, Targets.none(), 0.0, 0, 0.0, f"nothing seen: {why}")


def depth_in_metres(message: Message) -> Image:
    """Depth [m], shape (height, width), NaN where invalid, of a sensor_msgs/Image of encoding 32FC1 [m] or 16UC1 [mm].

    Raises ValueError for another encoding, or data that does not fit the size.
    """
    kinds = {"32FC1": "f4", "16UC1": "u2"}
    if message.encoding not in kinds:
        raise ValueError(f"camera/depth/image_raw: encoding = {message.encoding!r}, want one of {sorted(kinds)}")
    kind = np.dtype((">" if message.is_bigendian else "<") + kinds[message.encoding])
    height, width, step = int(message.height), int(message.width), int(message.step)
    data = np.frombuffer(message.data, np.uint8)
    if step < width * kind.itemsize or data.size != height * step:
        raise ValueError(f"camera/depth/image_raw: {data.size} bytes for {height} rows of {step}, {width} pixels each")
    raw = np.ascontiguousarray(data.reshape(height, step)[:, : width * kind.itemsize]).view(kind)
    depth = raw.astype(np.float32) * np.float32(1.0 if kind.kind == "f" else 1e-3)
    depth[~(depth > 0)] = np.nan
    return depth


def camera_pose(message: Message, frame: str) -> Array | None:
    """X_WC, shape (4, 4), of an optical frame from tf_static; None when it is not in there."""
    for item in message.transforms:
        if item.child_frame_id == frame and item.header.frame_id == FRAME:
            return transform_matrix(item.transform)
    return None


def points(t: int, p_W: Array) -> Message:
    """`sensor_msgs/PointCloud2` in world: x y z float32 [m]."""
    fields = [PointField(name, 4 * i, 7, 1) for i, name in enumerate("xyz")]  # 7: FLOAT32
    data = np.ascontiguousarray(p_W, "<f4").view(np.uint8).reshape(-1)
    return PointCloud2(header(t, FRAME), 1, len(p_W), fields, False, 12, 12 * len(p_W), data, True)


def surface(t: int, mesh: PerceivedMesh) -> Message:
    """`palpation_msgs/SurfaceMesh` in world."""
    vertices, normals = (np.ascontiguousarray(x, np.float32).reshape(-1) for x in (mesh.p_W, mesh.n_W))
    return SurfaceMesh(
        header(t, FRAME), vertices, normals, np.ascontiguousarray(mesh.triangles).reshape(-1), np.zeros(len(mesh.p_W), np.float32)
    )


def targets(t: int, perceived: Perceived) -> Message:
    """`palpation_msgs/PalpationTargets` in world."""
    found = perceived.targets
    return PalpationTargets(
        header(t, FRAME),
        [Point(*map(float, p)) for p in found.p_W],
        [Vector3(*map(float, n)) for n in found.n_W],
        found.line,
        perceived.sigma,
        perceived.frames,
        perceived.coverage,
        perceived.message,
    )
