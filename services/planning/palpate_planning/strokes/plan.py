"""From perceived targets to a planned examination: reachable targets, strokes, their postures, the approach.

Strokes are segments of arm motion: postures along them, reach and collisions, paths between them. A search requests its presses
one at a time, from the hover pose.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final, NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial import cKDTree

from palpate_bus.messages.codes import Reason
from palpate_models.numerics.frames import Array, Ints, apply, inverse, rigid
from palpate_models.scenario.patterns import scan_of
from palpate_models.scenario.schema import ExamInput
from palpate_planning.motion.kinematics import KINEMATIC_LIMITS, ArmKinematics, CollisionScene, ViewPyramid, region_corners
from palpate_planning.motion.planner import JointTrajectory, NoPathError, timed_motion
from palpate_planning.placement.redundancy import plan_redundancy, prepare
from palpate_planning.reasons import NO_CAUSE, Cause
from palpate_planning.strokes.coverage import Stroke, strokes, touches, transfer
from palpate_planning.strokes.path import SurfacePath, centre, frames_along, least_twist
from palpate_planning.wall.surface import PerceivedSurface


class SegmentTuning(NamedTuple):
    """Heights and sampling of segments."""

    hover_m: float = 0.025
    """Height of the sphere's deepest point above the surface before, between and after strokes: twice the usual error of the
    perceived surface (`wall.wall`)."""
    posture_every: int = 4
    """Inverse kinematics is solved at every n-th sample of a stroke; the postures between them are interpolated."""


SEGMENTS = SegmentTuning()

REACH = Cause(Reason.OUT_OF_REACH, "out of the arm's reach")
STRETCHED = Cause(Reason.ARM_STRETCHED, "within reach of a stretched arm only")

Place = tuple[float, float]
Infeasible = list[tuple[int, Cause]]
"""Samples of a path that the arm cannot take, with the cause."""


class Segment(NamedTuple):
    """One stroke, or the path from one stroke to the next."""

    path: SurfacePath
    """Path on the surface; a free motion uses only its ends."""
    contact: bool
    """True for a stroke; False for a path above the surface between strokes."""
    touch: bool = False
    """True if the wall is only touched, not pressed."""
    depth_m: float | None = None
    """Depth of a press [m]; None: the examination's depth."""
    free: JointTrajectory | None = None
    """A free motion, where the arm cannot take the straight path above the surface."""


@dataclass(slots=True)
class Layout:
    """All strokes and paths between them, and what prevents them. `segments` are complete only if it is feasible."""

    segments: list[Segment] = field(default_factory=list)
    breaks: set[int] = field(default_factory=set)
    """Targets after which a stroke has to end: the path to the next is out of reach or collides."""
    dropped: dict[int, Cause] = field(default_factory=dict)
    """Targets to skip, with the cause."""

    @property
    def infeasible(self) -> bool:
        """True if the arm cannot carry it out."""
        return bool(self.breaks or self.dropped)


class SegmentPlanner:
    """Plans strokes on one surface, given the postures of their targets, shape (k, n): k targets, n joints."""

    def __init__(
        self,
        kinematics: ArmKinematics,
        scene: CollisionScene,
        surface: PerceivedSurface,
        postures: Array,
        known: ExamInput,
        bend: float,
        free_motion: Callable[[Array, Array], JointTrajectory],
    ) -> None:
        """Prepare for one surface.

        Args:
            kinematics: of the arm.
            scene: in which the tool may touch the abdomen.
            surface: the perceived surface.
            postures: of the targets [rad], shape (k, n): k targets, n joints.
            known: examination and tool.
            bend: minimum bend of the elbow in strokes and on straight paths [rad].
            free_motion: plans from q0 to q1 [rad] without contact, or raises NoPathError.
        """
        self._kinematics, self._scene, self._surface = kinematics, scene, surface
        self._radius, self._depth = known.robot.indenter_radius_m, known.exam.depth_m
        self._postures, self._bend, self._free_motion = postures, bend, free_motion
        self._strokes: dict[tuple[bytes, bytes], tuple[SurfacePath, Infeasible]] = {}
        self._hovers: dict[Place, tuple[Array | None, Cause]] = {}
        self._paths: dict[tuple[Place, Place], tuple[Segment | None, Cause]] = {}
        self._R_ref = np.eye(3)

    def layout(self, pieces: list[Stroke]) -> Layout:
        """Return the strokes and the paths between them. Strokes and paths planned by earlier calls are reused."""
        layout = Layout()
        if pieces and not self._strokes:
            self._R_ref = self._kinematics.pose(self._postures[pieces[0].targets[0]])[:3, :3]
        for k, piece in enumerate(pieces):
            path, infeasible = self._stroke(piece)
            for sample, cause in infeasible:
                after = int(np.searchsorted(piece.visits, sample, side="right")) - 1
                target = int(piece.targets[after])
                if sample == piece.visits[after]:
                    layout.dropped[target] = cause
                else:
                    layout.breaks.add(target)
            for end in (0, -1):
                posture, cause = self.hover(piece, end)
                if posture is None:
                    layout.dropped[int(piece.targets[end])] = cause._replace(text=f"posture above it: {cause.text}")
            if k and not layout.infeasible:
                segment, cause = self._path_to_next(pieces[k - 1], piece)
                if segment is None:
                    layout.dropped[int(piece.targets[0])] = cause._replace(text=f"no path to it: {cause.text}")
                else:
                    layout.segments.append(segment)
            layout.segments.append(Segment(path, contact=True, touch=piece.touch))
        return layout

    def press_after(self, before: Stroke, press: Stroke, depth: float) -> tuple[Segment, ...]:
        """Return a press to `depth` [m] and the path to it from the end of the previous stroke; empty if impossible."""
        path, infeasible = self._path_of(press, depth)
        if infeasible or self.hover(press, 0)[0] is None:
            return ()
        transit, _ = self._path_to_next(before, press)
        return () if transit is None else (transit, Segment(path, contact=True, depth_m=depth))

    def hover(self, piece: Stroke, end: int) -> tuple[Array | None, Cause]:
        """Return the posture above the first (0) or last (-1) target [rad], shape (n,), or None and the cause."""
        place = _place(piece, end)
        if place not in self._hovers:
            p, n = (a[0] for a in self._surface.at(piece.xy[[end]]))
            goal = rigid(least_twist(-n, self._R_ref), centre(p, n, self._radius, -SEGMENTS.hover_m))
            near = self._postures[piece.targets[end]]
            solution = self._kinematics.solve(goal, near)
            if not solution.ok:
                self._hovers[place] = None, REACH
            elif not self._scene.free(solution.q):
                self._hovers[place] = None, collision(self._scene, solution.q)
            else:
                self._hovers[place] = solution.q, NO_CAUSE
        return self._hovers[place]

    def _stroke(self, piece: Stroke) -> tuple[SurfacePath, Infeasible]:
        key = piece.targets.tobytes(), piece.xy.tobytes()
        if key not in self._strokes:
            self._strokes[key] = self._path_of(piece, self._depth)
        return self._strokes[key]

    def _path_to_next(self, before: Stroke, after: Stroke) -> tuple[Segment | None, Cause]:
        """Return the path from above the end of one stroke to above the start of the next: straight, else a free motion."""
        key = (_place(before, -1), _place(after, 0))
        if key not in self._paths:
            xy, targets = transfer(before.xy[-1], after.xy[0]), np.array((before.targets[-1], after.targets[0]))
            path, infeasible = self._path_of(Stroke(xy, targets, np.array([0, len(xy) - 1])), -SEGMENTS.hover_m)
            start, goal = self.hover(before, -1)[0], self.hover(after, 0)[0]
            if not infeasible:
                self._paths[key] = (Segment(path, contact=False), NO_CAUSE)
            elif start is None or goal is None:
                self._paths[key] = (None, infeasible[0][1])
            else:
                try:
                    self._paths[key] = (Segment(path, contact=False, free=self._free_motion(start, goal)), NO_CAUSE)
                except NoPathError as error:
                    self._paths[key] = (None, Cause(Reason.NO_PATH, str(error)))
        return self._paths[key]

    def _path_of(self, stroke: Stroke, depth: float) -> tuple[SurfacePath, Infeasible]:
        """Return a stroke with postures at `depth` [m] near those of its targets, and the samples that the arm cannot take."""
        s, p, n, R = frames_along(self._surface, stroke.xy, self._R_ref)
        centres = centre(p, n, self._radius, depth)
        known = self._postures[stroke.targets]
        near = np.column_stack([np.interp(s, s[stroke.visits], column) for column in known.T])
        solved = np.unique(np.concatenate((np.arange(0, len(s), SEGMENTS.posture_every), stroke.visits, [len(s) - 1])))
        q = np.empty((len(solved), known.shape[1]))
        infeasible: Infeasible = []
        for row, i in enumerate(solved):
            solution = self._kinematics.solve(rigid(R[i], centres[i]), near[i])
            q[row] = solution.q
            if not solution.ok:
                infeasible.append((int(i), REACH))
            elif self._kinematics.stretched(solution.q, self._bend):
                infeasible.append((int(i), STRETCHED))
            elif not self._scene.free(solution.q):
                infeasible.append((int(i), collision(self._scene, solution.q)))
        between = np.asarray(CubicSpline(s[solved], q, bc_type="natural")(s)) if len(solved) > 1 else q
        return SurfacePath(s, p, n, R, between, stroke.targets, stroke.visits), infeasible


def collision(scene: CollisionScene, q: Array) -> Cause:
    """Return the cause that names what the arm collides with at `q` [rad], shape (n,)."""
    return Cause(Reason.COLLISION, f"the arm would collide: {', '.join(scene.collisions(q))}")


def _place(piece: Stroke, end: int) -> Place:
    """Return the start (0) or end (-1) of a stroke in the abdomen frame [m]."""
    x, y = piece.xy[end]
    return float(x), float(y)


_NEAREST: Final = 4
"""Number of targets tried where the place itself cannot be pressed."""


class PressRequest(NamedTuple):
    """A request of the search."""

    number: int
    xy: Array | None
    """Place to press, in the abdomen frame [m], shape (2,); None when the search is over."""
    depth_m: float = 0.0
    reason: str = ""
    """Text for the end of the search."""

    def shift_by(self, shift_A: Array) -> "PressRequest":
        """Return the same place of a body that has moved by `shift_A` [m], shape (2,), since the first view."""
        return self if self.xy is None else self._replace(xy=self.xy + shift_A)


class PressPlanner:
    """Plans presses at requested places. Only the worker uses it once the examination has begun."""

    def __init__(self, segments: SegmentPlanner, targets: Array, reachable: Array, last: Stroke) -> None:
        """Start above the end of the stroke `last`.

        Args:
            segments: planner of the segments.
            targets: in the abdomen frame [m], shape (n, 2).
            reachable: which of them can be reached, shape (n,).
            last: latest stroke.
        """
        self._segments, self._targets, self._last = segments, targets, last
        self._free = np.array(reachable, dtype=bool)

    def press(self, request: PressRequest) -> tuple[Segment, ...]:
        """Return the path to the requested place and a press there, or at the nearest possible target; empty if there is none."""
        assert request.xy is not None
        apart = np.where(self._free, np.linalg.norm(self._targets - request.xy, axis=1), np.inf)
        nearest = np.argsort(apart)[: min(_NEAREST, np.count_nonzero(self._free))]
        if not len(nearest):
            return ()
        places = [(request.xy, int(nearest[0])), *((self._targets[target], int(target)) for target in nearest)]
        for place, target in places:
            stroke = Stroke(place[None], np.array([target]), np.zeros(1, dtype=np.int64))
            planned = self._segments.press_after(self._last, stroke, request.depth_m)
            if planned:
                self._last = stroke
                return planned
        return ()


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
