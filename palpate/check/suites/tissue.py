"""Role tissue: the suite moves an indenter above it, into it, along it and out again. The patient holds their breath."""

from typing import Any, Final, NamedTuple

import numpy as np

from palpate.check.rig import Feed, ReceivedMessage, Rig
from palpate_bus.messages import Pose, Quaternion, ToolState, Twist, Vector3, header
from palpate_bus.messages.geometry import mesh_arrays, point_message, pose_matrix, rotation, vector, vector_message
from palpate_models.numerics.frames import Array

WRENCH = "sim/contact_wrench"
TRUTH = "truth/indentation"
PATIENT = "truth/patient"
STILL = ("phantom.breathing.kind=none", "phantom.motion.kind=none")
"""Settings of a scenario whose patient neither breathes nor moves, so that the indenter alone causes forces."""


class TestPress(NamedTuple):
    """The press that the suite makes."""

    speed_mps: float = 0.02
    depth_m: float = 0.008
    clearance_m: float = 0.01


PRESS: Final = TestPress()


class PressingTool:
    """An indenter that moves along straight legs; poses in world."""

    def __init__(self, p: Array, radius: float) -> None:
        self.p, self.v, self.radius = p.astype(float), np.zeros(3), radius
        self._since = 0

    def lead(self, rig: Rig, to: Array, seconds: float) -> list[ReceivedMessage]:
        """Move to `to` [m] in `seconds`; returns the contact wrenches during this time."""
        start, t0 = self.p.copy(), rig.t
        self.v = (to - start) / seconds

        def source(t: int) -> Any:
            self.p = start + self.v * min((t - t0) / 1e9, seconds)
            return _state(t, self.p, self.v, self.radius)

        return rig.run(seconds, {"sim/tool_state": source})[WRENCH]

    def rest(self, rig: Rig, seconds: float) -> list[ReceivedMessage]:
        """Stay for `seconds`; return the contact wrenches."""
        return self.lead(rig, self.p.copy(), seconds)


def _state(t: int, p: Array, v: Array, radius: float) -> Any:
    pose = Pose(point_message(p), Quaternion(1.0, 0.0, 0.0, 0.0))
    return ToolState(header(t, "world"), pose, Twist(vector_message(v), Vector3(0.0, 0.0, 0.0)), radius)


def force(item: ReceivedMessage) -> Array:
    """Return the force of a wrench [N], shape (3,)."""
    return vector(item.message.wrench.force)


def suite(rig: Rig) -> None:
    """Check truth, contact, friction, energy and silence."""
    rig.section("truth")
    rig.run(0.05, {})
    truth = rig.last("truth/phantom")
    if not rig.arrives("truth/phantom is there from the start", truth, "a latched message"):
        return
    p_W, n_W = _spot(rig, truth)
    radius = rig.settings.scenario.robot.indenter_radius_m
    _check_patient(rig, truth)
    rig.section("contact")
    touch = p_W + n_W * radius
    tool = PressingTool(touch + n_W * PRESS.clearance_m, radius)
    above = tool.rest(rig, 0.2)
    _check_free(rig, above, "no force out of contact")
    legs: list[tuple[list[ReceivedMessage], Array]] = []
    down = tool.lead(rig, touch - n_W * PRESS.depth_m, (PRESS.clearance_m + PRESS.depth_m) / PRESS.speed_mps)
    legs.append((down, tool.v.copy()))
    _check_press(rig, down, n_W)
    legs.append((tool.rest(rig, 0.3), np.zeros(3)))
    tangent = np.cross(n_W, (0.0, 1.0, 0.0))
    tangent /= np.linalg.norm(tangent)
    slide = tool.lead(rig, tool.p + tangent * 0.01, 0.01 / PRESS.speed_mps)
    legs.append((slide, tool.v.copy()))
    _check_slide(rig, slide, tangent, n_W)
    _check_truth(rig, n_W)
    rise_m = PRESS.depth_m + 2 * PRESS.clearance_m
    up = tool.lead(rig, tool.p + n_W * rise_m, rise_m / PRESS.speed_mps)
    legs.append((up, tool.v.copy()))
    _check_free(rig, tool.rest(rig, 0.2), "no force after contact")
    _check_energy(rig, legs)
    _surface(rig)
    rig.section("silence")
    silent: Feed = {}
    received = rig.run(0.3, silent)[WRENCH]
    ok = bool(received) and all(np.all(np.isfinite(force(item))) for item in received)
    rig.expect("continues without tool states", ok, "one wrench per tick", f"{len(received)} messages")


def _spot(rig: Rig, truth: Any) -> tuple[Array, Array]:
    """Return a point near the umbilicus and the outward normal there, in world."""
    vertices, normals, *_ = mesh_arrays(truth.surface)
    sizes = {len(vertices), len(normals), len(truth.stiffness), len(truth.background), len(truth.lesion)}
    rig.expect("one normal and stiffness per vertex", len(sizes) == 1, "equal lengths", sorted(sizes))
    unit = np.abs(np.linalg.norm(normals, axis=1) - 1).max() if len(normals) else np.inf
    rig.below("normals are unit vectors, outward", unit if normals[:, 2].mean() > 0 else np.inf, 1e-3, "off a length of 1")
    R_WA, p_WA = rotation(truth.pose.orientation), vector(truth.pose.position)
    top = np.argmin(np.hypot(vertices[:, 0], vertices[:, 1]) - 1e-3 * vertices[:, 2])
    return R_WA @ vertices[top] + p_WA, R_WA @ normals[top]


def _check_patient(rig: Rig, phantom: Any) -> None:
    patient = rig.last(PATIENT)
    if patient is None:
        return
    apart = np.abs(pose_matrix(patient.pose) - pose_matrix(phantom.pose)).max()
    rig.below("truth/patient: at the pose of truth/phantom", apart, 1e-6, "m apart")
    rig.equal("truth/patient: holds their breath", patient.excursion, 0)


def _check_free(rig: Rig, received: list[ReceivedMessage], name: str) -> None:
    rig.below(name, max((np.linalg.norm(force(item)) for item in received[len(received) // 2 :]), default=np.inf), 1e-6, "N")


def _check_press(rig: Rig, received: list[ReceivedMessage], n_W: Array) -> None:
    normal = np.array([force(item) @ n_W for item in received])
    got = f"{normal[-1]:.2f} N at {PRESS.depth_m * 1e3:.0f} mm, minimum {normal.min():.3f} N"
    outward = normal[-1] > 0.05 and normal.min() > -1e-6
    rig.expect("a pressed surface pushes back, outward", outward, "a positive force along the normal", got)
    tenths = normal[normal > 0][:: max(1, int((normal > 0).sum()) // 10)]
    rising = bool(np.all(np.diff(tenths) > -0.02 * max(normal.max(), 1e-9)))
    rig.expect("force rises with depth", rising, "rising", tenths.round(2))
    last = force(received[-1])
    side = np.linalg.norm(last - normal[-1] * n_W)
    rig.below("pressed straight, it pushes straight", side, 0.2 * normal[-1], "N, tangential")


def _check_slide(rig: Rig, received: list[ReceivedMessage], tangent: Array, n_W: Array) -> None:
    tail = received[len(received) // 2 :]
    along = float(np.mean([force(item) @ tangent for item in tail]))
    normal = float(np.mean([force(item) @ n_W for item in tail]))
    rig.below("friction opposes sliding", along, 0.3 * normal, "N along the motion")
    rig.below("and is less than the normal force", abs(along), normal, "N")


def _check_truth(rig: Rig, n_W: Array) -> None:
    truth, wrench = rig.last(TRUTH), rig.log[WRENCH][-1]
    if truth is None:
        return
    normal = float(force(wrench) @ n_W)
    rig.expect("truth/indentation: depth is positive in contact", truth.depth > 0, "above 0 mm", f"{truth.depth * 1e3:.1f} mm")
    off = abs(truth.normal_force - normal)
    rig.below("truth/indentation: the force is that of the wrench", off, 0.1 * abs(normal) + 0.1, "N off")


def _check_energy(rig: Rig, legs: list[tuple[list[ReceivedMessage], Array]]) -> None:
    """Check passivity: over a closed loop the work of the tissue on the tool is not positive."""
    work = np.cumsum([0.0, *(float(force(item) @ v) * 1e-3 for received, v in legs for item in received)])
    limit = 1e-5 + 0.02 * abs(work.min())
    rig.below("is passive: a loop of contact costs energy", work[-1], limit, "mJ of work on the tool", 1e3)


def _surface(rig: Rig) -> None:
    meshes = [item.message for item in rig.log["sim/surface"]]
    if not meshes:
        return
    sizes = {(len(m.vertices), len(m.triangles)) for m in meshes}
    rig.equal("sim/surface: one mesh throughout", len(sizes), 1)
    inside = all(int(np.max(m.triangles, initial=0)) < len(m.vertices) // 3 for m in meshes)
    rig.expect("sim/surface: triangles index its vertices", inside, "indices below the number of vertices")
    first = np.asarray(meshes[0].vertices).reshape(-1, 3)
    dent = max(float(np.max(np.linalg.norm(np.asarray(m.vertices).reshape(-1, 3) - first, axis=1))) for m in meshes)
    rig.within("sim/surface: shows the indentation", 1e3 * dent, 0.3e3 * PRESS.depth_m, 3e3 * PRESS.depth_m, "mm")
