"""A short plausible run, as messages: the arm moves, a dome is pressed, a map grows, a finding is made."""

from collections.abc import Iterable, Iterator
from pathlib import Path as Folder
from typing import Any

import numpy as np
from mcap.writer import CompressionType, Writer
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from palpate_bus import messages as msg
from palpate_bus.contract import contract
from palpate_bus.messages import geometry
from palpate_bus.testing import HandInbox
from palpate_models.numerics.frames import Array, look_at
from palpate_models.robot import lbr
from palpate_models.robot.arm import link_transforms
from palpate_models.scenario.schema import Robot

MS = 1_000_000
OBSERVED = frozenset(topic.name for topic, _ in contract().inputs("dashboard"))
Messages = dict[str, Any]
X_WA = np.array((0.56, 0.0, 0.93))


class FakeInbox(HandInbox):
    """The input of the dashboard: messages stay new until newer ones come."""

    def bring(self, t: int, messages: Messages) -> None:
        self.messages.update(messages)
        self.stamps.update(dict.fromkeys(messages, t))

    def latest(self, topic: str) -> Any:
        assert topic in OBSERVED, f"{topic} is not for the dashboard"
        return super().latest(topic)

    def new(self, topic: str) -> list[Any]:
        return [self.messages[topic]] if topic in self.messages else []


def forward(joints: Array) -> dict[str, tuple[Array, Rotation]]:
    """Link positions and rotations in world."""
    X = {"world": np.eye(4)}
    for parent, link, X_PL in link_transforms(joints, Robot()):
        X[link] = X[parent] @ X_PL
    return {link: (pose[:3, 3], Rotation.from_matrix(pose[:3, :3])) for link, pose in X.items() if link != "world"}


def dome(n: int = 55) -> tuple[NDArray[np.float32], NDArray[np.uint32]]:
    """Return a smooth belly in A with n x n vertices."""
    x, y = np.meshgrid(np.linspace(-0.17, 0.17, n), np.linspace(-0.21, 0.21, n))
    z = 0.1 * (np.cos(x / 0.18 * 1.3) * np.cos(y / 0.24 * 1.1) - 1.0) - 0.0
    vertices = np.stack((x, y, z), axis=-1).reshape(-1, 3).astype(np.float32)
    i = np.arange(n * n).reshape(n, n)
    a, b, c, d = (k.ravel() for k in (i[:-1, :-1], i[:-1, 1:], i[1:, :-1], i[1:, 1:]))
    return vertices, np.vstack((np.stack((a, b, d), 1), np.stack((a, d, c), 1))).astype(np.uint32)


def surface(t: int, vertices: NDArray[np.float32], triangles: NDArray[np.uint32], frame: str) -> Any:
    return geometry.mesh_message(msg.header(t, frame), vertices, triangles=triangles)


def pose(position: Array, rotation: Rotation | None = None) -> Any:
    q = (0.0, 0.0, 0.0, 1.0) if rotation is None else rotation.as_quat()
    return msg.Pose(msg.Point(*map(float, position)), msg.Quaternion(*map(float, q)))


def transforms(t: int, poses: dict[str, tuple[Array, Rotation]]) -> Any:
    return geometry.frames_message(msg.header(t, "world"), list(poses), np.array([(*p, *r.as_quat()) for p, r in poses.values()]))


def ratio_field(vertices: NDArray[np.float32]) -> Array:
    d = np.hypot(vertices[:, 0] + 0.05, vertices[:, 1] + 0.05)
    return np.asarray(1.0 + 3.0 / (1.0 + np.exp(np.minimum((d - 0.03) / 0.003, 50.0))))


def latched() -> Messages:
    vertices, triangles = dome()
    ratio = ratio_field(vertices)
    lesion = np.where(ratio > 2.5, 0, -1).astype(np.int32)
    background = np.full(len(vertices), 1.7e5)
    truth = msg.PhantomTruth(surface(0, vertices, triangles, "abdomen"), ratio * background, background, lesion, pose(X_WA))
    X_WC = look_at(np.array((0.95, -0.45, 1.85)), np.array((0.56, 0.0, 0.9)))
    camera = X_WC[:3, 3], Rotation.from_matrix(X_WC[:3, :3])
    return {"truth/phantom": truth, "tf_static": transforms(0, {"camera_depth_optical_frame": camera})}


def look(t: int) -> Messages:
    image = np.full((480, 640), 1.05, dtype=np.float32)
    image += 0.1 * np.hypot(*np.meshgrid(np.linspace(-1, 1, 640), np.linspace(-1, 1, 480))).astype(np.float32)
    image[:20] = np.nan
    k = np.array(((585.0, 0, 319.5), (0, 585.0, 239.5), (0, 0, 1)))
    frame = "camera_depth_optical_frame"
    vertices, triangles = dome()
    world = (vertices + X_WA).astype(np.float32)
    cloud = world.repeat(5, axis=0)
    cloud[0] = np.nan
    targets = world[(np.abs(vertices[:, :2]) < 0.1).all(axis=1)][::3]
    above = targets + np.array((0.0, 0.0, 0.02))
    return {
        "camera/depth/camera_info": geometry.camera_info(msg.header(t, frame), (480, 640), k),
        "camera/depth/image_raw": geometry.depth_message(msg.header(t, frame), image),
        "perception/points": geometry.cloud_message(msg.header(t, "world"), cloud),
        "perception/surface": surface(t, world, triangles, "world"),
        "perception/targets": msg.PalpationTargets(
            msg.header(t, "world"), [geometry.point_message(p) for p in targets], [msg.Vector3(0.0, 0.0, 1.0)] * len(targets),
            np.zeros(len(targets), np.uint32), 0.001, 20, 1.0, 0, "",
        ),
        "planning/path": msg.Path(msg.header(t, "world"), [msg.PoseStamped(msg.header(t, "world"), pose(p)) for p in above]),
    }  # fmt: skip


def stiffness_map(t: int, share: float) -> Any:
    vertices, triangles = dome(41)
    scanned = (np.abs(vertices[:, :2]) < 0.1).all(axis=1) & (vertices[:, 1] < -0.1 + 0.2 * share)
    mean = (1.7e5 * ratio_field(vertices)).astype(np.float32)
    none = np.full(len(vertices), -1, np.int32)
    return msg.StiffnessMap(
        msg.header(t, "abdomen"), vertices.ravel(), triangles.ravel(), 1e-5 * mean, 0.8e-5 * mean, 1.2e-5 * mean, 1e-5 * mean,
        mean, scanned, np.where(scanned, 0, 1).astype(np.uint8), none, 0.01, 1.7, 100,
    )  # fmt: skip


def findings(t: int) -> Any:
    item = msg.Finding(msg.Point(-0.05, -0.05, -0.01), "RLQ", 0.0028, 3.9, 3.4, 4.4, 0.99, *[0.0] * 4, msg.Finding.KIND_LUMP)
    return msg.Findings(msg.header(t, "abdomen"), [item], [], True)


def robot_status(t: int, torque: Array) -> Any:
    """The rest of the message is not drawn."""
    zero = np.zeros(7)
    return msg.RobotStatus(msg.header(t), 1, 0, "", zero, zero, geometry.wrench_message(zero), torque, 0, "", torque)


def exam(t: int, phase: int, message: str, depth: float, force: float, visited: int) -> Any:
    pressed = force > 0.1
    return msg.ExamState(
        msg.header(t, "world"), phase, message, visited, 200, 1, pressed, pressed, False, False, 0.01 if pressed else 0.0,
        depth, force, msg.Point(0.0, 0.0, 0.0), msg.Vector3(0.0, 0.0, 1.0), -1, 0.0005, 0.0, 1, False, 0, "",
    )  # fmt: skip


def patient(s: float) -> tuple[float, Any]:
    """Excursion [m] and pose of a patient who breathes three times and shifts by 10 mm in the middle."""
    return 0.004 * (1 - float(np.cos(6 * np.pi * s))), pose(X_WA + np.array((0.010 if s > 0.5 else 0.0, 0.0, 0.0)))


def run(seconds: float, step_ms: int = 50) -> Iterator[tuple[int, Messages]]:
    """(time [ns], messages that arrived since the step before)."""
    rest, triangles = dome()
    world = rest + X_WA
    for t in range(0, int(seconds * 1000) * MS, step_ms * MS):
        s = t / (seconds * 1e9)
        new: Messages = latched() if t == 0 else {}
        joints = lbr.HOME + np.array((0.4 * np.sin(6.28 * s), 0.5 * s, 0, 0.2 * s, 0, 0, 0))
        poses = forward(joints)
        pressing = s > 0.3
        centre = np.array((-0.1 + 0.2 * s, 0.09 * np.sin(12 * s)))
        dent = 0.01 * np.exp(-((rest[:, :2] - centre) ** 2).sum(axis=1) / 2 / 0.02**2) if pressing else 0.0
        moved = world - np.array((0.0, 0.0, 1.0)) * np.reshape(dent, (-1, 1))
        near = np.argmin(((rest[:, :2] - centre) ** 2).sum(axis=1))
        force = 2.5 * float(ratio_field(rest[near : near + 1])[0]) if pressing else 0.0
        if pressing:
            poses["indenter"] = (moved[near] + np.array((0, 0, 0.015)), Rotation.from_euler("x", np.pi))
        depth = 0.01 if pressing else -0.2
        phase = 5 if pressing else (1 if s > 0.1 else 0)
        new |= {
            "sim/link_poses": transforms(t, poses),
            "sim/surface": surface(t, moved.astype(np.float32), triangles, "world"),
            "exam/state": exam(t, phase, "scanning line 3" if pressing else "", depth, force, int(200 * s)),
            "truth/indentation": msg.IndentationTruth(msg.header(t), depth, force, 0.3, force, 9, msg.Point(0, 0, 0), 1.7e5),
            "truth/patient": msg.PatientTruth(msg.header(t, "world"), *patient(s)),
            "robot/status": robot_status(t, 20.0 * np.sin(6 * s + np.arange(7.0))),
            "clock": msg.Clock(msg.time_message(t)),
        }
        if 0.1 < s < 0.3:
            new |= look(t)
        if pressing:
            new["assessment/map"] = stiffness_map(t, (s - 0.3) / 0.6)
        if s > 0.95:
            new["assessment/findings"] = findings(t)
        if t % (1000 * MS) == 0:
            step = [msg.KeyValue("step", "0.1 ms")]
            rows = [msg.DiagnosticStatus(0, role, "running", "", step) for role in ("robot", "tissue", "control")]
            new["diagnostics"] = msg.DiagnosticArray(msg.header(t), rows)
        yield t, new


def write_recording(folder: Folder, steps: Iterable[tuple[int, Messages]]) -> Folder:
    """Write messages as the MCAP recording of a run's folder, in chunks of 0.2 MB; return the file."""
    path = folder / "recording_mcap" / "recording_mcap_0.mcap"
    path.parent.mkdir(parents=True)
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=200_000, compression=CompressionType.NONE)
        writer.start()
        channels: dict[str, int] = {}
        for t, messages in steps:
            for topic, message in messages.items():
                kind = contract().topics[topic].type
                if topic not in channels:
                    schema = writer.register_schema(kind, "ros2msg", b"")
                    channels[topic] = writer.register_channel(f"/{topic}", "cdr", schema)
                writer.add_message(channels[topic], t, msg.codec.encode(message, kind), t)
        writer.finish()
    return path
