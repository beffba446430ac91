"""From perceived targets to a planned examination: reachable targets, strokes, their postures, the approach."""

from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from palpate_models.numerics.frames import Array, Ints, apply, inverse, rigid
from palpate_models.scenario.patterns import scan_of
from palpate_models.scenario.schema import ExamInput
from palpate_planning.motion.kinematics import KINEMATIC_LIMITS, ArmKinematics
from palpate_planning.motion.planner import NoPathError, timed_motion
from palpate_planning.motion.scene import CollisionScene, ViewPyramid, region_corners
from palpate_planning.motion.timing import JointTrajectory
from palpate_planning.placement.redundancy import plan_redundancy, prepare
from palpate_planning.reasons import Cause
from palpate_planning.strokes.coverage import strokes, touches
from palpate_planning.strokes.path import centre
from palpate_planning.strokes.requests import PressPlanner
from palpate_planning.strokes.segments import REACH, STRETCHED, Segment, SegmentPlanner, collision
from palpate_planning.wall.surface import PerceivedSurface


class ScanPostures(NamedTuple):
    """Camera view and turns of the arm during a scan of the surface."""

    view_margin_m: float = 0.03
    """Margin about the region that the view includes: perception needs the surface there."""
    turns_rad: tuple[float, ...] = (0.0, 1.2, -1.2, 2.2, -2.2)
    """Turns of the whole arm away from the table."""


SCAN = ScanPostures()


class PerceivedAbdomen(NamedTuple):
    """Result of perception: targets in coverage order and the surface. World frame."""

    positions: Array
    """[m], shape (n, 3)."""
    lines: Ints
    """Scan line of each target, shape (n,)."""
    vertices: Array
    """Mesh of the surface [m], shape (k, 3)."""
    triangles: Ints
    """Vertex indices, shape (l, 3)."""
    surface: PerceivedSurface


class ExamPlan(NamedTuple):
    """All motions of an examination."""

    approach: JointTrajectory
    """Motion to above the first target."""
    segments: tuple[Segment, ...]
    """Strokes alternate with paths above the surface."""
    skipped: dict[int, Cause]
    """Cause by target."""
    presses: PressPlanner | None = None
    """Plans the presses requested by a search; None without a search."""

    def poses(self, radius: float, depth: float) -> Array:
        """Return poses of the indenter at depth along all strokes, about 5 mm apart, shape (n, 4, 4)."""
        out = []
        for segment in self.segments:
            if segment.contact and not segment.touch:
                step = max(1, len(segment.path.s) * 5 // max(1, round(segment.path.length * 1e3)))
                centres = centre(segment.path.p, segment.path.n, radius, depth)
                out += [rigid(segment.path.R[i], centres[i]) for i in range(0, len(centres), step)]
        return np.array(out)


class ExamPlanner:
    """Plans for one robot and examination, with its own kinematics and scenes: it shares no state with the steps."""

    def __init__(self, known: ExamInput, period_s: float) -> None:
        """Trajectories are sampled every `period_s`."""
        self._known, self._period_s = known, period_s
        self._kinematics = ArmKinematics(known.robot, known.limits)

    def prepare(self) -> None:
        """Prepare what needs no surface; this halves the planning time of an examination."""
        prepare(self._known.robot, self._known.limits.force_working_n)

    def motion(self, q0: Array, q1: Array, perceived: PerceivedAbdomen | None) -> JointTrajectory:
        """Return a collision-free timed motion from q0 to q1. Raises NoPathError."""
        mesh = None if perceived is None else (perceived.vertices, perceived.triangles)
        return self._motion(CollisionScene(self._kinematics, self._known.robot, mesh), q0, q1)

    def examination(
        self, perceived: PerceivedAbdomen, q_now: Array, wanted: frozenset[int] | None = None, bend: float | None = None
    ) -> ExamPlan:
        """Return the examination of the `wanted` targets, of all if None.

        With a `bend` [rad] it continues an examination: the elbow is bent by at least as much, without touches before
        the strokes. Raises NoPathError if no target can be reached or there is no path to the first.
        """
        known, exam, mesh = self._known, self._known.exam, (perceived.vertices, perceived.triangles)
        free, contact = (CollisionScene(self._kinematics, known.robot, mesh, touch) for touch in (False, True))
        xy = apply(inverse(np.array(known.X_WA)), perceived.positions)[:, :2]
        min_bend = bend or KINEMATIC_LIMITS.straight_rad
        postures, skipped = self._reachable(perceived, xy, q_now, contact, min_bend)
        segments = SegmentPlanner(
            self._kinematics, contact, perceived.surface, postures, known, min_bend, lambda q0, q1: self._motion(free, q0, q1)
        )
        joined = scan_of(exam, perceived.surface.in_A).joined
        breaks: set[int] = set()
        while True:  # ends: each round takes targets or joints away
            usable = np.array([i not in skipped and (wanted is None or i in wanted) for i in range(len(xy))], dtype=bool)
            scan = [] if exam.searched else strokes(xy, perceived.lines, usable, joined, exam.mode, exam.spacing_m, breaks)
            pieces = scan if bend and scan else touches(xy, usable) + scan
            layout = segments.layout(pieces)
            if not layout.infeasible:
                break
            breaks |= layout.breaks
            skipped |= layout.dropped
        if not pieces:
            reasons = "; ".join(sorted({cause.text for cause in skipped.values()})) or "there are none"
            raise NoPathError(f"no target is left of {len(xy)}: {reasons}")
        start, _ = segments.hover(pieces[0], 0)
        assert start is not None, "strokes without a hover posture were dropped"
        missed = {i: cause for i, cause in skipped.items() if wanted is None or i in wanted}
        approach = self._motion(free, q_now, start)
        presses = PressPlanner(segments, xy, usable, pieces[-1]) if exam.searched else None
        return ExamPlan(approach, tuple(layout.segments), missed, presses)

    def _motion(self, scene: CollisionScene, q0: Array, q1: Array) -> JointTrajectory:
        return timed_motion(scene, self._kinematics, self._known.limits, q0, q1, self._known.exam.seed, self._period_s)

    def _reachable(
        self, perceived: PerceivedAbdomen, xy: Array, q_now: Array, scene: CollisionScene, bend: float
    ) -> tuple[Array, dict[int, Cause]]:
        """Return a posture for each target, shape (k, n) for n joints, and the targets that none reaches, with the cause."""
        p, n = perceived.surface.at(xy)
        robot, limits = self._known.robot, self._known.limits
        centres = centre(p, n, robot.indenter_radius_m, self._known.exam.depth_m)
        margin, force_n = limits.joint_margin_rad, limits.force_working_n
        chosen = plan_redundancy(robot, centres, n, q_now, joint_margin_rad=margin, force_n=force_n)
        skipped: dict[int, Cause] = {}
        for i, q in enumerate(chosen.q):
            if not chosen.reachable[i]:
                skipped[i] = REACH
            elif self._kinematics.stretched(q, bend):
                skipped[i] = STRETCHED
            elif not scene.free(q):
                skipped[i] = collision(scene, q)
        return chosen.q, skipped


def nearest_targets(before: Array, targets: Array) -> Ints:
    """Return the index of the nearest target `before`, shape (k, 3), for each of `targets`, shape (n, 3), in world [m].

    Both about their middle, since the patient has moved. A pattern that depends on the surface may have other targets then.
    """
    return np.asarray(cKDTree(before - before.mean(axis=0)).query(targets - targets.mean(axis=0))[1])


def look_postures(known: ExamInput, *, hidden: bool = True) -> list[Array]:
    """Return collision-free postures to look from [rad], shape (n,) each: those that leave the view free first, by their turn.

    They are the home posture, and it turned by the first joint within its limits: the arm cannot follow a set-point beyond
    them, and jumps once the motion from there comes back within them. The supervisor stops a tool outside the workspace.
    `hidden`: also those that may hide the view.
    """
    kinematics = ArmKinematics(known.robot, known.limits)
    size = (known.exam.region_m[0] + 2 * SCAN.view_margin_m, known.exam.region_m[1] + 2 * SCAN.view_margin_m)
    corners = region_corners(np.array(known.X_WA), known.exam.centre_m, size)
    view = ViewPyramid(kinematics, known.robot, np.array(known.camera.position_m), corners)
    scene = CollisionScene(kinematics, known.robot)
    postures = []
    for turn in SCAN.turns_rad:
        q = kinematics.arm.home_rad.copy()
        q[0] += turn
        p_A = apply(inverse(np.array(known.X_WA)), kinematics.pose(q)[:3, 3])
        inside = (np.array(known.limits.workspace_min_m) < p_A) & (p_A < np.array(known.limits.workspace_max_m))
        within = not turn or (kinematics.lower[0] <= q[0] <= kinematics.upper[0] and inside.all())
        if within and scene.free(q) and (hidden or view.clear(q)):
            postures.append(q)
    return sorted(postures, key=lambda q: not view.clear(q))
