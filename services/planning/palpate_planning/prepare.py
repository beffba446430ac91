"""From targets to a whole planned examination: who is reachable, the strokes, their postures, the way there."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from palpate_models.frames import apply, inverse
from palpate_models.placement import plan_redundancy, prepare
from palpate_models.scenario import ExamInput
from palpate_planning.coverage import strokes
from palpate_planning.kinematics import Kinematics
from palpate_planning.legs import REACH, Leg, LegPlanner
from palpate_planning.motion import NoPathError, timed_motion
from palpate_planning.poses import centre, pose
from palpate_planning.scene import Scene
from palpate_planning.surface import Surface
from palpate_planning.timing import JointTrajectory

Array = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Seen:
    """What perception gave: targets in coverage order and the surface. World frame."""

    positions: Array
    """[m], shape (n, 3)."""
    lines: Ints
    """Scan line of each target, shape (n,)."""
    vertices: Array
    """Mesh of the surface [m], shape (k, 3)."""
    triangles: Ints
    """Vertex indices, shape (l, 3)."""
    surface: Surface
    noise: float = 0.0
    """Standard deviation of the surface that perception estimates, its motion included [m]."""


@dataclass(frozen=True, slots=True)
class ExamPlan:
    """All motion of an examination."""

    approach: JointTrajectory
    """From where the arm was to above the first target."""
    legs: tuple[Leg, ...]
    """Alternating: contact, way, contact, ..."""
    skipped: dict[int, str]
    """Reason by target."""

    def poses(self, radius: float, depth: float) -> Array:
        """Poses of the indenter at depth along all strokes, about 5 mm apart, shape (n, 4, 4)."""
        out = []
        for leg in self.legs:
            if leg.contact:
                step = max(1, len(leg.path.s) * 5 // max(1, round(leg.path.length * 1e3)))
                centres = centre(leg.path.p, leg.path.n, radius, depth)
                out += [pose(leg.path.R[i], centres[i]) for i in range(0, len(centres), step)]
        return np.array(out)

    def skipped_in_words(self) -> str:
        """Empty, or how many targets are skipped and why."""
        counts = Counter(self.skipped.values())
        return "; ".join(f"{count} targets skipped: {reason}" for reason, count in sorted(counts.items()))


class Planner:
    """Plans for one robot and exam. Shares no state with the steps: it has kinematics and scenes of its own."""

    def __init__(self, known: ExamInput) -> None:
        self._known = known
        self._kinematics = Kinematics(known.robot, known.limits)

    def prepare(self) -> None:
        """Makes what needs no surface: an examination is planned in half the time afterwards."""
        prepare(self._known.robot, self._known.limits.force_working_n)

    def motion(self, q0: Array, q1: Array, seen: Seen | None) -> JointTrajectory:
        """Collision-free timed motion from q0 to q1. Raises NoPathError."""
        mesh = None if seen is None else (seen.vertices, seen.triangles)
        return self._motion(Scene(self._kinematics, self._known.robot, mesh), q0, q1)

    def examination(self, seen: Seen, q_now: Array) -> ExamPlan:
        """The whole examination. Raises NoPathError if no target is left or there is no way to the first."""
        known, exam, mesh = self._known, self._known.exam, (seen.vertices, seen.triangles)
        free, contact = (Scene(self._kinematics, known.robot, mesh, touch) for touch in (False, True))
        xy = apply(inverse(np.array(known.X_WA)), seen.positions)[:, :2]
        postures, skipped = self._reachable(seen, xy, q_now, contact)
        legs = LegPlanner(
            self._kinematics,
            contact,
            seen.surface,
            postures,
            known.robot.indenter_radius_m,
            exam.depth_m,
            lambda q0, q1: self._motion(free, q0, q1),
        )
        breaks: set[int] = set()
        while True:  # ends: each round takes targets or joints away
            usable = np.array([i not in skipped for i in range(len(xy))], dtype=bool)
            pieces = strokes(xy, seen.lines, usable, exam.pattern, exam.mode, exam.spacing_m, breaks)
            layout = legs.lay(pieces)
            if not layout.troubled:
                break
            breaks |= layout.breaks
            skipped |= layout.dropped
        if not pieces:
            reasons = "; ".join(sorted(set(skipped.values()))) or "there are none"
            raise NoPathError(f"no target is left of {len(xy)}: {reasons}")
        start = legs.hover(pieces[0], 0)
        assert start is not None, "a stroke that cannot be hovered over is trouble"
        return ExamPlan(self._motion(free, q_now, start), tuple(layout.legs), skipped)

    def _motion(self, scene: Scene, q0: Array, q1: Array) -> JointTrajectory:
        return timed_motion(scene, self._kinematics, self._known.limits, q0, q1, self._known.seed)

    def _reachable(self, seen: Seen, xy: Array, q_now: Array, scene: Scene) -> tuple[Array, dict[int, str]]:
        """A posture for each target, shape (n, 7), and the targets that none reaches, with the reason."""
        p, n = seen.surface.at(xy)
        robot, limits = self._known.robot, self._known.limits
        chosen = plan_redundancy(
            robot,
            centre(p, n, robot.indenter_radius_m, self._known.exam.depth_m),
            n,
            q_now,
            joint_margin_rad=limits.joint_margin_rad,
            force_n=limits.force_working_n,
        )
        skipped: dict[int, str] = {}
        for i, q in enumerate(chosen.q):
            if not chosen.reachable[i]:
                skipped[i] = REACH
            elif not scene.free(q):
                skipped[i] = f"the arm would collide: {', '.join(scene.collisions(q))}"
        return chosen.q, skipped
