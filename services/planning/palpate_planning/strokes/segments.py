"""Strokes as segments of arm motion: postures along them, reach and collisions, paths between them."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline

from palpate_bus.messages.codes import Reason
from palpate_models.numerics.frames import Array, rigid
from palpate_models.scenario.schema import ExamInput
from palpate_planning.motion.kinematics import ArmKinematics
from palpate_planning.motion.planner import NoPathError
from palpate_planning.motion.scene import CollisionScene
from palpate_planning.motion.timing import JointTrajectory
from palpate_planning.reasons import NO_CAUSE, Cause
from palpate_planning.strokes.coverage import Stroke, transfer
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
