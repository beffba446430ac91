"""Role tissue: the suite moves an indenter above it, into it, along it and out again. The patient holds their breath."""

from typing import Any

import numpy as np

from palpate.check.report import ConformanceReport
from palpate.check.rig import Feed, ReceivedMessage, Rig
from palpate_bus.messages import Point, Pose, Quaternion, ToolState, Twist, Vector3
from palpate_bus.messages.geometry import rotation, vector
from palpate_bus.messages.stamps import header
from palpate_models.numerics.frames import Array

WRENCH = "sim/contact_wrench"
TRUTH = "truth/indentation"
PATIENT = "truth/patient"
STILL = ("phantom.breathing.kind=none", "phantom.motion.kind=none")
"""Settings of a scenario whose patient neither breathes nor moves, so that the indenter alone causes forces."""
SPEED_MPS = 0.02
DEPTH_M = 0.008
CLEARANCE_M = 0.01


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
    pose = Pose(Point(*map(float, p)), Quaternion(1.0, 0.0, 0.0, 0.0))
    twist = Twist(Vector3(*map(float, v)), Vector3(0.0, 0.0, 0.0))
    return ToolState(header(t, "world"), pose, twist, radius)


def force(item: ReceivedMessage) -> Array:
    """Return the force of a wrench [N], shape (3,)."""
    f = item.message.wrench.force
    return np.array((f.x, f.y, f.z))


def suite(rig: Rig, report: ConformanceReport) -> None:
    """Check truth, contact, friction, energy and silence."""
    report.section("truth")
    rig.run(0.05, {})
    truth = rig.last("truth/phantom")
    if not report.expect(
        "truth/phantom is there from the start", truth is not None, "a latched message", "there" if truth is not None else "none"
    ):
        return
    p_W, n_W = _spot(truth, report)
    radius = rig.settings.scenario.robot.indenter_radius_m
    _check_patient(rig, truth, report)
    report.section("contact")
    touch = p_W + n_W * radius
    tool = PressingTool(touch + n_W * CLEARANCE_M, radius)
    above = tool.rest(rig, 0.2)
    _check_free(above, report, "no force out of contact")
    legs: list[tuple[list[ReceivedMessage], Array]] = []
    down = tool.lead(rig, touch - n_W * DEPTH_M, (CLEARANCE_M + DEPTH_M) / SPEED_MPS)
    legs.append((down, tool.v.copy()))
    _check_press(rig, down, n_W, report)
    legs.append((tool.rest(rig, 0.3), np.zeros(3)))
    tangent = np.cross(n_W, (0.0, 1.0, 0.0))
    tangent /= np.linalg.norm(tangent)
    slide = tool.lead(rig, tool.p + tangent * 0.01, 0.01 / SPEED_MPS)
    legs.append((slide, tool.v.copy()))
    _check_slide(slide, tangent, n_W, report)
    _check_truth(rig, n_W, report)
    up = tool.lead(rig, tool.p + n_W * (DEPTH_M + 2 * CLEARANCE_M), (DEPTH_M + 2 * CLEARANCE_M) / SPEED_MPS)
    legs.append((up, tool.v.copy()))
    _check_free(tool.rest(rig, 0.2), report, "no force after contact")
    _check_energy(legs, report)
    _surface(rig, report)
    report.section("silence")
    silent: Feed = {}
    received = rig.run(0.3, silent)[WRENCH]
    ok = bool(received) and all(np.all(np.isfinite(force(item))) for item in received)
    report.expect("continues without tool states", ok, "one wrench per tick", f"{len(received)} messages")


def _spot(truth: Any, report: ConformanceReport) -> tuple[Array, Array]:
    """Return a point near the umbilicus and the outward normal there, in world."""
    vertices = np.asarray(truth.surface.vertices, np.float64).reshape(-1, 3)
    normals = np.asarray(truth.surface.normals, np.float64).reshape(-1, 3)
    sizes = {len(vertices), len(normals), len(truth.stiffness), len(truth.background), len(truth.lesion)}
    report.expect("one normal and stiffness per vertex", len(sizes) == 1, "equal lengths", sorted(sizes))
    unit = np.abs(np.linalg.norm(normals, axis=1) - 1).max() if len(normals) else np.inf
    report.expect(
        "normals are unit vectors, outward",
        unit < 1e-3 and normals[:, 2].mean() > 0,
        "length 1, z up in the abdomen frame",
        f"{unit:.2g} off",
    )
    R_WA, p_WA = rotation(truth.pose.orientation), vector(truth.pose.position)
    top = np.argmin(np.hypot(vertices[:, 0], vertices[:, 1]) - 1e-3 * vertices[:, 2])
    return R_WA @ vertices[top] + p_WA, R_WA @ normals[top]


def _check_patient(rig: Rig, phantom: Any, report: ConformanceReport) -> None:
    patient = rig.last(PATIENT)
    if patient is None:
        return
    apart = float(np.linalg.norm(vector(patient.pose.position) - vector(phantom.pose.position)))
    turned = rotation(phantom.pose.orientation).T @ rotation(patient.pose.orientation)
    report.expect(
        "truth/patient: at the pose of truth/phantom",
        apart < 1e-6 and float(np.trace(turned)) > 3 - 1e-9,
        "the same pose",
        f"{1e3 * apart:.3g} mm apart",
    )
    report.expect("truth/patient: holds their breath", patient.excursion == 0, "0 mm", f"{1e3 * patient.excursion:.2f} mm")


def _check_free(received: list[ReceivedMessage], report: ConformanceReport, name: str) -> None:
    worst = max((float(np.linalg.norm(force(item))) for item in received[len(received) // 2 :]), default=np.inf)
    report.expect(name, worst < 1e-6, "0 N", f"{worst:.3g} N")


def _check_press(rig: Rig, received: list[ReceivedMessage], n_W: Array, report: ConformanceReport) -> None:
    normal = np.array([force(item) @ n_W for item in received])
    report.expect(
        "a pressed surface pushes back, outward",
        normal[-1] > 0.05 and normal.min() > -1e-6,
        "a positive force along the normal",
        f"{normal[-1]:.2f} N at {DEPTH_M * 1e3:.0f} mm, least {normal.min():.3f} N",
    )
    tenths = normal[normal > 0][:: max(1, int((normal > 0).sum()) // 10)]
    rising = bool(np.all(np.diff(tenths) > -0.02 * max(normal.max(), 1e-9)))
    report.expect("force rises with depth", rising, "rising", tenths.round(2))
    last = force(received[-1])
    side = float(np.linalg.norm(last - normal[-1] * n_W))
    report.expect("pressed straight, it pushes straight", side < 0.2 * normal[-1], "tangential below 20 %", f"{side:.3f} N")


def _check_slide(received: list[ReceivedMessage], tangent: Array, n_W: Array, report: ConformanceReport) -> None:
    tail = received[len(received) // 2 :]
    along = float(np.mean([force(item) @ tangent for item in tail]))
    normal = float(np.mean([force(item) @ n_W for item in tail]))
    report.expect(
        "friction opposes sliding", along < 0.3 * normal, "not with the motion", f"{along:.2f} N along, {normal:.2f} N normal"
    )
    report.expect(
        "and is less than the normal force", abs(along) < normal, "a coefficient below 1", f"{abs(along) / max(normal, 1e-9):.2f}"
    )


def _check_truth(rig: Rig, n_W: Array, report: ConformanceReport) -> None:
    truth, wrench = rig.last(TRUTH), rig.log[WRENCH][-1]
    if truth is None:
        return
    normal = float(force(wrench) @ n_W)
    report.expect(
        "truth/indentation: depth is positive in contact",
        truth.depth > 0,
        f"about {DEPTH_M * 1e3:.0f} mm",
        f"{truth.depth * 1e3:.1f} mm",
    )
    near = abs(truth.normal_force - normal) < 0.1 * abs(normal) + 0.1
    report.expect("truth/indentation: the force is that of the wrench", near, f"{normal:.2f} N", f"{truth.normal_force:.2f} N")


def _check_energy(legs: list[tuple[list[ReceivedMessage], Array]], report: ConformanceReport) -> None:
    """Check passivity: over a closed loop the work of the tissue on the tool is not positive."""
    work = 0.0
    stored = 0.0
    for received, v in legs:
        for item in received:
            work += float(force(item) @ v) * 1e-3
            stored = min(stored, work)
    report.expect(
        "is passive: a loop of contact costs energy",
        work <= 1e-5 + 0.02 * abs(stored),
        "work on the tool at most 0 J",
        f"{work * 1e3:.3f} mJ of {abs(stored) * 1e3:.2f} mJ put in",
    )


def _surface(rig: Rig, report: ConformanceReport) -> None:
    meshes = [item.message for item in rig.log["sim/surface"]]
    if not meshes:
        return
    sizes = {(len(m.vertices), len(m.triangles)) for m in meshes}
    report.expect("sim/surface: one mesh throughout", len(sizes) == 1, "constant topology", sorted(sizes))
    inside = all(int(np.max(m.triangles, initial=0)) < len(m.vertices) // 3 for m in meshes)
    report.expect("sim/surface: triangles index its vertices", inside, "indices below the number of vertices")
    first = np.asarray(meshes[0].vertices).reshape(-1, 3)
    dent = max(float(np.max(np.linalg.norm(np.asarray(m.vertices).reshape(-1, 3) - first, axis=1))) for m in meshes)
    report.expect(
        "sim/surface: shows the indentation",
        0.3 * DEPTH_M < dent < 3 * DEPTH_M,
        f"about {DEPTH_M * 1e3:.0f} mm",
        f"{dent * 1e3:.1f} mm",
    )
