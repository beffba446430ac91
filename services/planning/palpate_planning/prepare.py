"""From targets to a whole planned examination: who is reachable, the strokes, their postures, the motions in and out."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from palpate_models.frames import apply, inverse
from palpate_models.placement import plan_redundancy
from palpate_models.scenario import ExamInput
from scipy.interpolate import CubicSpline

from palpate_planning.coverage import Stroke, strokes, transfer
from palpate_planning.kinematics import Kinematics
from palpate_planning.motion import NoPathError, plan
from palpate_planning.path import SurfacePath, lay
from palpate_planning.poses import centre, pose
from palpate_planning.scene import Scene
from palpate_planning.surface import Surface
from palpate_planning.timing import JointTrajectory, joint_trajectory, rounded

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

HOVER_M = 0.025
"""Height of the sphere's deepest point above the surface between free motion and contact phase."""
POSTURE_EVERY = 4
"""A posture is solved at every so many samples of a stroke."""


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


@dataclass(frozen=True, slots=True)
class Leg:
    """A part of the examination on or above the surface."""

    path: SurfacePath
    contact: bool
    """At depth; else above the surface, on the way to the next stroke."""


@dataclass(frozen=True, slots=True)
class ExamPlan:
    """All motion of an examination."""

    approach: JointTrajectory
    """From where the arm was to above the first target."""
    legs: tuple[Leg, ...]
    """Alternating: contact, transfer, contact, ..."""
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
        self._radius, self._depth = known.robot.indenter_radius_m, known.exam.depth_m

    def motion(self, q0: Array, q1: Array, seen: Seen | None) -> JointTrajectory:
        """Collision-free timed motion from q0 to q1. Raises NoPathError."""
        mesh = None if seen is None else (seen.vertices, seen.triangles)
        return self._timed(Scene(self._kinematics, self._known.robot, mesh), q0, q1)

    def examination(self, seen: Seen, q_now: Array) -> ExamPlan:
        """The whole examination. Raises NoPathError if no target is left or there is no way to the first."""
        robot, mesh = self._known.robot, (seen.vertices, seen.triangles)
        free, contact = (Scene(self._kinematics, robot, mesh, touch) for touch in (False, True))
        xy = apply(inverse(np.array(self._known.X_WA)), seen.positions)[:, :2]
        postures, skipped = self._reachable(seen, xy, q_now, contact)
        legs: list[Leg] = []
        breaks: set[int] = set()
        exam, troubled = self._known.exam, True
        while troubled:  # ends: each round takes targets or joints away
            usable = np.array([i not in skipped for i in range(len(xy))], dtype=bool)
            pieces = strokes(xy, seen.lines, usable, exam.pattern, exam.mode, exam.spacing_m, breaks)
            legs, parted, dropped = self._legs(seen.surface, pieces, postures, contact)
            troubled = bool(parted or dropped)
            breaks |= parted
            skipped |= dropped
        if not legs:
            reasons = "; ".join(sorted(set(skipped.values()))) or "there are none"
            raise NoPathError(f"no target is left of {len(xy)}: {reasons}")
        return ExamPlan(self._timed(free, q_now, self.hover(legs[0].path, 0.0)), tuple(legs), skipped)

    def hover(self, path: SurfacePath, s: float) -> Array:
        """Posture above a path [rad], shape (7,). Raises NoPathError if out of reach."""
        place = path.at(s)
        solution = self._kinematics.solve(pose(place.R, centre(place.p, place.n, self._radius, -HOVER_M)), place.q, place.q)
        if not solution.ok:
            raise NoPathError(f"{HOVER_M * 1e3:.0f} mm above the target at {np.round(place.p, 3).tolist()} is out of reach")
        return solution.q

    def _timed(self, scene: Scene, q0: Array, q1: Array) -> JointTrajectory:
        points = plan(scene, q0, q1, self._kinematics.upper, self._known.seed)
        for blend in (0.25, 0.1, 0.03):
            smooth = rounded(points, blend)
            if len(points) == 2 or scene.path_free(smooth):
                return joint_trajectory(self._kinematics, smooth, self._known.limits)
        raise NoPathError(f"corners of the motion to {np.round(q1, 3).tolist()} cannot be rounded without collision")

    def _reachable(self, seen: Seen, xy: Array, q_now: Array, scene: Scene) -> tuple[Array, dict[int, str]]:
        """A posture for each target, shape (n, 7), and the targets that none reaches, with the reason."""
        p, n = seen.surface.at(xy)
        limits = self._known.limits
        chosen = plan_redundancy(
            self._known.robot,
            centre(p, n, self._radius, self._depth),
            n,
            q_now,
            joint_margin_rad=limits.joint_margin_rad,
            force_n=limits.force_working_n,
        )
        skipped: dict[int, str] = {}
        for i, q in enumerate(chosen.q):
            if not chosen.reachable[i]:
                skipped[i] = "out of the arm's reach"
            elif not scene.free(q):
                skipped[i] = f"the arm would collide: {', '.join(scene.collisions(q))}"
        return chosen.q, skipped

    def _legs(
        self, surface: Surface, pieces: list[Stroke], postures: Array, scene: Scene
    ) -> tuple[list[Leg], set[int], dict[int, str]]:
        """Strokes as paths with transfers between them; targets after which to break a stroke; targets to skip, and why."""
        legs: list[Leg] = []
        breaks: set[int] = set()
        dropped: dict[int, str] = {}
        R = self._kinematics.pose(postures[pieces[0].targets[0]])[:3, :3] if pieces else np.eye(3)
        for k, piece in enumerate(pieces):
            first = int(piece.targets[0])
            if k:
                before = pieces[k - 1]
                way = transfer(before.xy[-1], piece.xy[0])
                ends = np.array([before.targets[-1], first])
                path, bad = self._path(surface, Stroke(way, ends, np.array([0, len(way) - 1])), R, postures, -HOVER_M, scene)
                if bad:
                    dropped[first] = f"the way to it: {bad[0][1]}"
                legs.append(Leg(path, contact=False))
                R = path.R[-1]
            path, bad = self._path(surface, piece, R, postures, self._depth, scene)
            for sample, why in bad:
                after = int(np.searchsorted(piece.visits, sample, side="right")) - 1
                if sample in piece.visits:
                    dropped[int(piece.targets[after])] = why
                else:
                    breaks.add(int(piece.targets[after]))
            legs.append(Leg(path, contact=True))
            R = path.R[-1]
        return legs, breaks, dropped

    def _path(
        self, surface: Surface, stroke: Stroke, R_first: Array, postures: Array, depth: float, scene: Scene
    ) -> tuple[SurfacePath, list[tuple[int, str]]]:
        """A stroke with postures at `depth`, near those of its targets; and samples out of reach or in collision, with why."""
        s, p, n, R = lay(surface, stroke.xy, R_first)
        centres = centre(p, n, self._radius, depth)
        known = postures[stroke.targets]
        near = np.column_stack([np.interp(s, s[stroke.visits], known[:, j]) for j in range(7)])
        solved = np.unique(np.concatenate((np.arange(0, len(s), POSTURE_EVERY), stroke.visits, [len(s) - 1])))
        q = np.empty((len(solved), 7))
        bad: list[tuple[int, str]] = []
        for row, i in enumerate(solved):
            solution = self._kinematics.solve(pose(R[i], centres[i]), near[i], near[i])
            q[row] = solution.q
            if not solution.ok:
                bad.append((int(i), "out of the arm's reach"))
            elif not scene.free(solution.q):
                bad.append((int(i), f"the arm would collide: {', '.join(scene.collisions(solution.q))}"))
        between = np.asarray(CubicSpline(s[solved], q, bc_type="natural")(s)) if len(solved) > 1 else q
        return SurfacePath(s, p, n, R, between, stroke.targets, stroke.visits), bad
