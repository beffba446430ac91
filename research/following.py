"""Error of the followed wall against the truth, with camera, perception and a palpating arm in view; no other service.

Run: `python -m research.following [SECONDS]`; prints the README's table.
"""

import sys
from dataclasses import dataclass, field
from time import thread_time
from typing import Any

import numpy as np

from palpate_bus.messages import (
    MS,
    NS,
    CameraTrigger,
    RobotStatus,
    SurfaceMesh,
    SurfaceMotion,
    TFMessage,
    Vector3,
    Wrench,
    header,
    nanoseconds,
)
from palpate_bus.testing import HandInbox
from palpate_camera.backends.kinect.service import CameraService, transform
from palpate_models.numerics.frames import Array, apply, inverse, matrix
from palpate_models.patient.motion import BodyMotion, BreathingCurve
from palpate_models.patient.phantom import build_phantom
from palpate_models.robot.arm import link_transforms, tool_jacobian, tool_pose
from palpate_models.scenario.load import exam_input, load_scenario, plant_input, true_pose
from palpate_models.scenario.schema import Scenario
from palpate_perception.service import PerceptionService

TICK = 100 * MS
LOOK_S = 12.0
"""Time before the arm comes into view."""
READY = np.array((0.0, 0.45, 0.0, -1.4, 0.0, 1.2, 0.0))
"""About the ready posture, the tool downwards [rad]."""
CASES: dict[str, tuple[str, int, tuple[str, ...]]] = {
    "8 mm, typical errors": ("healthy", 1000, ("phantom.breathing.peak_to_peak_m=0.008",)),
    "the same, another patient": ("healthy", 1001, ("phantom.breathing.peak_to_peak_m=0.008",)),
    "a person": ("person", 1002, ("phantom.breathing.peak_to_peak_m=0.008",)),
    "12 mm": ("healthy", 1003, ("phantom.breathing.peak_to_peak_m=0.012",)),
    "poor errors": ("poor_errors", 1004, ("phantom.breathing.peak_to_peak_m=0.008",)),
    "still, no errors": ("clean", 1005, ()),
    "coughs": ("healthy", 1006, ("phantom.breathing.coughs_per_min=3",)),
    "breath held": ("healthy", 1007, ("phantom.breathing.kind=held",)),
    "shift of 10 mm": ("restless", 1008, ("phantom.motion.at_s=40",)),
    "another": ("restless", 1009, ("phantom.motion.at_s=40",)),
    "a third": ("restless", 1010, ("phantom.motion.at_s=40",)),
    "turn of 3 degrees": ("restless", 1011, ("phantom.motion.kind=turn", "phantom.motion.at_s=40")),
}


class HandedInbox(HandInbox):
    """Without encoding, which is not measured here."""

    def put(self, topic: str, message: Any, stamp: int | None = None) -> HandInbox:
        """Add a message as newest and new."""
        self.messages[topic] = message
        self.events.setdefault(topic, []).append(message)
        return self


class Patient:
    """True body of a patient as input of the camera."""

    def __init__(self, case: Scenario) -> None:
        self.model = build_phantom(case.phantom, case.seed)
        self.curve = BreathingCurve(case.phantom.breathing, case.seed)
        self.motion = BodyMotion(case.phantom.motion, case.seed)
        self.X_WA = matrix(true_pose(case))
        self._triangles = self.model.triangles.astype(np.uint32).ravel()

    def skin(self, t: int) -> Any:
        """sim/surface at time `t` [ns]."""
        lifted = self.model.vertices + self.curve.excursion(t / NS) * self.model.breathing[:, np.newaxis] * self.model.normals
        p_W = apply(self.X_WA @ self.motion.pose(t / NS), lifted).astype(np.float32)
        none = np.empty(0, np.float32)
        return SurfaceMesh(header(t, "world"), p_W.ravel(), none, self._triangles, none)


def reach(case: Scenario, p_W: Array, q: Array, rounds: int) -> Array:
    """Return joint positions [rad] with the indenter at `p_W` [m], pointing down: damped least squares from `q`."""
    for _ in range(rounds):
        X = tool_pose(q, case.robot)
        tilt = np.cross(X[:3, 2], (0.0, 0.0, -1.0))
        error = np.concatenate((p_W - X[:3, 3], 0.5 * tilt))
        J = tool_jacobian(q, case.robot)
        q = q + J.T @ np.linalg.solve(J @ J.T + 1e-4 * np.eye(6), error)
    return q


def arm(case: Scenario, t: int, q: Array, q_true: Array) -> tuple[Any, Any]:
    """Return robot/status with the measured joints, and sim/link_poses with the true ones."""
    zero, free = np.zeros(7), Wrench(Vector3(0.0, 0.0, 0.0), Vector3(0.0, 0.0, 0.0))
    status = RobotStatus(header(t), RobotStatus.MODE_ACTIVE, 0, "", q, zero, free, zero, 0, "", zero)
    X, links = np.eye(4), []
    for _, child, X_PC in link_transforms(q_true, case.robot):
        X = X @ X_PC
        links.append(transform(t, "world", child, X))
    return status, TFMessage(links)


@dataclass
class Run:
    """Published motion, one row per small image after the first scan."""

    t_s: list[float] = field(default_factory=list)
    state: list[int] = field(default_factory=list)
    motion: list[Array] = field(default_factory=list)
    uncertainty: list[float] = field(default_factory=list)
    cost_s: list[float] = field(default_factory=list)
    shift: list[Array] = field(default_factory=list)
    surface: Any = None
    correction: Any = None
    answered_s: float = np.nan


def run(case: Scenario, seconds: float, again_s: float = 0.0) -> tuple[Run, Patient]:
    """Run a scan, then `seconds` [s] of strokes over the region; with `again_s` a second scan then [s], the arm out of view."""
    patient, result = Patient(case), Run()
    camera, perception = CameraService(plant_input(case)), PerceptionService(exam_input(case))
    seen, inputs = HandedInbox(), HandedInbox().receive(camera.start())
    X_WA = np.array(exam_input(case).X_WA)
    (cx, cy), (width, height) = case.exam.centre_m, case.exam.region_m
    err = np.random.default_rng(case.seed).normal(0.0, 0.001, 7)  # zeros of the joints, as errors.arm
    home = reach(case, X_WA[:3, 3] + (-0.25, 0.0, 0.45), READY, 60)
    image: dict[str, Any] = {}
    q = home
    for k in range(round((LOOK_S + seconds) * 10)):
        t = k * TICK
        looks = (2, round(10 * again_s)) if again_s else (2,)
        trigger = {"planning/camera_trigger": CameraTrigger(header(t), case.camera.frames)} if k in looks else {}
        if again_s and t >= again_s * NS:
            q = home
        elif t > LOOK_S * NS:
            phase = (t / NS - LOOK_S) / 8.0  # a line of 8 s, to and fro
            p = np.array((cx + width * ((0.1 * phase) % 1 - 0.5), cy + height * (abs(2 * (phase % 1) - 1) - 0.5), 0.01))
            q = reach(case, apply(X_WA, p[np.newaxis])[0], q, 1 if t > (LOOK_S + 1) * NS else 10)
        status, links = arm(case, t, q, q + err)
        begun = thread_time()
        seen.receive({"sim/surface": patient.skin(t), "sim/link_poses": links, **trigger})
        begun = thread_time()
        sent = dict(camera.step(t, seen))
        small = {topic: sent[topic] for topic in sent if topic.startswith("camera/follow")}
        inputs.receive({**image, **small, "robot/status": status, **trigger})
        out = perception.step(t, inputs)
        cost = thread_time() - begun
        image = {topic: sent[topic] for topic in sent if topic not in small}
        if "perception/surface" in out:
            result.surface, result.answered_s = out["perception/surface"], t / NS
            continue
        if result.surface is None:
            continue
        result.correction = out.get("perception/correction", result.correction)
        (message,) = out["perception/motion"]
        result.t_s.append(nanoseconds(message.header.stamp) / NS)
        result.state.append(message.state)
        result.motion.append(np.array((message.displacement, *message.forecast[1:])))
        result.uncertainty.append(message.uncertainty)
        result.shift.append(np.array((message.shift.x, message.shift.y)))
        result.cost_s.append(cost)
    return result, patient


def heights(result: Run, patient: Patient) -> tuple[Array, Array]:
    """Return mode and height error [m] of the perceived surface against the wall at the end of expiration, at its vertices."""
    p_W = np.asarray(result.surface.vertices, np.float64).reshape(-1, 3)
    p_A = apply(inverse(patient.X_WA), p_W)
    front = patient.model.normals[:, 2] > 0.3
    nearest = np.argmin(np.linalg.norm(p_A[:, np.newaxis, :2] - patient.model.vertices[front][np.newaxis, :, :2], axis=2), axis=1)
    true = patient.model.breathing[front][nearest]
    off = np.sum((p_A - patient.model.vertices[front][nearest]) * patient.model.normals[front][nearest], axis=1)
    return np.asarray(result.surface.breathing) - true, off


def main() -> None:
    """Print the table."""
    seconds = float(sys.argv[1]) if len(sys.argv) > 1 else 120.0
    wanted = sys.argv[2:] or list(CASES)
    print(
        "| case | answered [s] | mode RMS | surface, mean, sd [mm] | now | +100 ms | +200 ms: RMS [mm] while quiet "
        "| quiet, spoiled, moved, lost [%] | moved noticed after [s] | cost [ms], median, 95 % |\n|" + "---|" * 9
    )
    for name in wanted:
        scenario, seed, settings = CASES[name]
        case = load_scenario(scenario, settings, seed)
        result, patient = run(case, seconds)
        t, state, motion = np.array(result.t_s), np.array(result.state), np.array(result.motion)
        quiet = state == SurfaceMotion.QUIET
        error = [
            1e3 * np.sqrt(np.mean((motion[quiet, k] - [patient.curve.excursion(x + 0.05 * k) for x in t[quiet]]) ** 2))
            for k in (0, 2, 4)
        ]
        share = 100 * np.bincount(state, minlength=4) / len(state)
        moved = t[state == SurfaceMotion.MOVED]
        noticed = "" if not len(moved) else f"{moved[0] - patient.motion.at_s:.1f}" if patient.motion.moves else "FALSE"
        mode, off = heights(result, patient)
        cost = 1e3 * np.quantile(result.cost_s, (0.5, 0.95))
        cells = (
            name,
            f"{result.answered_s:.1f}",
            f"{np.sqrt(np.mean(mode**2)):.3f}",
            f"{1e3 * off.mean():.2f}, {1e3 * off.std():.2f}",
            *(f"{x:.2f}" for x in error),
            ", ".join(f"{x:.0f}" for x in share),
            noticed,
            f"{cost[0]:.1f}, {cost[1]:.1f}",
        )
        print(f"| {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
