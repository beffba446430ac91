"""The strokes of an examination on a patient without an arm.

Planning's own code moves the indenter: coverage, path, the stroke with its touch, regulation of depth against force. The errors
of arm, camera and force sensor are drawn from those of whole examinations (`palpate.quick.errors`). `palpate.quick.case`
makes exam/state, perception/surface and truth/indentation from the rows.
"""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from math import sqrt
from typing import Final, NamedTuple

import numpy as np

from palpate.quick.errors import Loop
from palpate.quick.patient import PERIOD_S, Patient, seen_lattice
from palpate.truth.pressed import TrueBody, TrueSurface
from palpate_models.numerics.frames import Array, Ints, apply, inverse
from palpate_models.scenario.load import ScenarioError, exam_input
from palpate_models.scenario.patterns import scan_of
from palpate_models.scenario.schema import Following, Scenario
from palpate_planning import stroke as planning
from palpate_planning.contact import THRESHOLDS, ContactMeasurement
from palpate_planning.interruptions import WALL
from palpate_planning.stroke_motion import StrokeMotion
from palpate_planning.strokes.coverage import Stroke, strokes, transfer
from palpate_planning.strokes.path import SurfacePath, frames_along
from palpate_planning.strokes.plan import Segment
from palpate_planning.wall.surface import Foot, PerceivedSurface
from palpate_planning.wall.wall import Breath, Wall, WallEstimate

_DENSE_M: Final = 0.0003
"""Spacing of the places of a path: about the travel of the indenter in a period."""
_DOWN: Final = np.diag((1.0, -1.0, -1.0))
"""Orientation of the tool, with its z axis into the body."""
_NO_ARM: Final = np.zeros(7)
_NOWHERE: Final = np.zeros(3)
_FOOT: Final = Foot(_NOWHERE, _NOWHERE, 0.0, _NOWHERE[:2])


class SkinPath(NamedTuple):
    """A path on the perceived and on the true skin: g places, about _DENSE_M apart."""

    segment: Segment
    per_m: float
    """Places per metre of the path."""
    believed_W: list[list[float]]
    """Points of the perceived surface [m], g of three, in world."""
    outward_W: list[list[float]]
    """Its outward unit normals, g of three."""
    place: Array
    """Points of the true skin at rest [m], shape (g, 3), in that frame."""
    normal: Array
    """True outward unit normals there, shape (g, 3)."""
    breathing: list[float]
    """Share of the breathing excursion there, g of them."""
    error_m: list[float]
    """Height of the perceived above the true surface there [m], g of them."""
    target: list[int]
    """Index of the latest target, g of them."""
    gains: Array
    """Rows that map a force in that frame to the measured normal force, shape (g, 3)."""


@dataclass
class PeriodRow:
    """One period of an examination."""

    time: float
    path: SkinPath
    at: int
    """Index of the place on its path."""
    stage: planning.StrokeStage
    depth: float
    """Measured [m]."""
    setpoint: float
    """[m]"""
    force: float
    """Measured [N]."""
    followed: float
    """Displacement of the skin by the breath that the set-point follows [m]."""
    stroke: int
    """Number of the latest descent."""
    true_depth: float
    """Below the breathing skin [m]."""
    true_force: Array
    """On the sphere [N], shape (3,), in the true frame of the patient."""
    touching: bool
    steady: bool
    limited: bool


class _Descent(planning.Descent):
    """A descent whose touch corrects no wall: the error of its zero is drawn when the sensor is tared."""

    def __init__(self, motion: StrokeMotion, depth: float, on_tared: Callable[[int], None]) -> None:
        """`on_tared` is called with the number of the stroke."""
        super().__init__(motion, depth)
        self._on_tared = on_tared

    def rest(self, height: float) -> bool:
        tared = super().rest(height)
        if tared:
            self._on_tared(self.stroke)
        return tared

    def learn(self, now: planning.StrokeInput) -> None:
        """Leave the wall as it is."""


class QuickExamination:
    """One examination of one patient."""

    def __init__(self, scenario: Scenario, loop: Loop) -> None:
        """`loop`: errors of arm, camera and force sensor in this examination."""
        self.loop = loop
        """Errors of arm, camera and force sensor."""
        self._exam = scenario.exam
        self._X_WA = np.array(exam_input(scenario).X_WA)
        self.patient = Patient(scenario, time=loop.begin_s)
        """The patient."""
        self._R_AtW = self.patient.X_WA[:3, :3].T
        model = self.patient.tissue.model
        X_AAt = inverse(self._X_WA) @ self.patient.X_WA
        lying = TrueBody(apply(X_AAt, model.vertices), model.triangles, self._X_WA)
        self._X_AtA = inverse(X_AAt)
        self._skin = TrueSurface(lying)
        """The true skin at rest, in A as registered."""
        self._breathing = self._skin.between(model.breathing)
        self._mean_excursion = self.patient.tissue.breathing.mean_m
        self._believed = PerceivedSurface.from_mesh(*self.perceived, self._X_WA)
        wall = Wall(self._believed, Breath())
        self._motion = StrokeMotion(self._exam, scenario.limits, scenario.robot, PERIOD_S, wall)
        self._descent = _Descent(self._motion, self._exam.depth_m, self._tare)
        self._gated = self._exam.breathing is Following.GATE
        self._open = True
        self._path: SkinPath
        self._before: Array | None = None
        """End of the previous stroke, in A as registered [m], shape (2,)."""
        self._zero_m = 0.0
        self._force, self._load, self._touching = 0.0, 0.0, False
        self._depth = -planning.STROKE.hop_height_m
        self._count = 0

    def run(self) -> list[PeriodRow]:
        """Carry out the examination; return measurements and truth of every period. Raises ScenarioError for a search."""
        if self._exam.searched:
            raise ScenarioError("exam.pattern = search: expected a scan, such as lines, for tier: quick has no role search")
        return self._drive(self._strokes())

    def press(self, xy: Array, depth_m: float) -> list[PeriodRow]:
        """Move to a place in A as registered [m], shape (2,), and press there, as requested by a search."""
        target = np.zeros(1, dtype=np.int64)
        return self._drive(self._stroke(Stroke(xy[None], target, target), depth_m))

    def _drive(self, stages: planning.Stages[None]) -> list[PeriodRow]:
        rows: list[PeriodRow] = []
        next(stages)
        with suppress(StopIteration):
            while True:
                contact = self._measure_contact()
                stage = stages.send(planning.StrokeInput(self._count, contact, gate_open=self._open))
                rows.append(self._period(stage, contact))
        return rows

    def _strokes(self) -> planning.Stages[None]:
        """Planning's strokes over all targets, with paths between them."""
        scan, exam = scan_of(self._exam, self._believed.in_A), self._exam
        xy = scan.targets
        usable = np.ones(len(xy), dtype=bool)
        for stroke in strokes(xy, scan.line_of_target, usable, scan.joined, exam.mode, exam.spacing_m):
            yield from self._stroke(stroke)

    def _stroke(self, stroke: Stroke, depth_m: float | None = None) -> planning.Stages[None]:
        motion = self._motion
        if self._before is not None:
            self._start(self._lay(transfer(self._before, stroke.xy[0]), stroke.targets[:1], contact=False))
            yield from planning.travel(motion, motion.segment.path.length)
        self._start(self._lay(stroke.xy, stroke.targets, stroke.visits, depth_m=depth_m))
        yield from planning.press(motion, self._descent)
        yield from planning.lift(motion, lambda t: planning.STROKE.hop_height_m)
        self._before = stroke.xy[-1]

    def _start(self, path: SkinPath) -> None:
        self._path = path
        self._motion.start(path.segment)

    # --- the true and the perceived skin ------------------------------------------------------------------------------

    @cached_property
    def perceived(self) -> tuple[Array, Array]:
        """The perceived surface as perception's mesh: points [m] and outward unit normals in world, shape (n, 3)."""
        p, n = self._skin.points(seen_lattice(self._exam))
        seen = np.isfinite(p).all(axis=1)
        p, n = p[seen], n[seen]
        p = p + n * self.loop.wrong(p[:, :2])[:, None]
        return apply(self._X_WA, p), n @ self._X_WA[:3, :3].T

    @property
    def shares(self) -> Array:
        """True share of the breathing excursion at each of these points, shape (n,)."""
        shares = self._breathing(apply(inverse(self._X_WA), self.perceived[0])[:, :2])
        return np.asarray(np.nan_to_num(shares))  # a point that an error shifts over the border has none

    def _lay(
        self, xy: Array, targets: Ints, visits: Ints | None = None, *, contact: bool = True, depth_m: float | None = None
    ) -> SkinPath:
        s, p, n, R = frames_along(self._believed, xy, _DOWN)
        visited: Ints = np.zeros(len(targets), dtype=np.int64) if visits is None else visits
        path = SurfacePath(s, p, n, R, np.zeros((len(s), 7)), targets, visited)
        count = max(1, round(path.length / _DENSE_M))
        at = np.linspace(0.0, path.length, count + 1)
        dense = np.column_stack([np.interp(at, s, xy[:, k]) for k in (0, 1)])
        believed, outward = self._believed.at(dense)
        place, normal = self._skin.points(dense + self.loop.aside_m)
        return SkinPath(
            segment=Segment(path, contact=contact, depth_m=depth_m),
            per_m=count / path.length if path.length else 0.0,
            believed_W=believed.tolist(),
            outward_W=outward.tolist(),
            place=apply(self._X_AtA, place),
            normal=normal @ self._X_AtA[:3, :3].T,
            breathing=self._breathing(dense + self.loop.aside_m).tolist(),
            error_m=self.loop.wrong(dense).tolist(),
            target=targets[np.maximum(np.searchsorted(path.visits, at, side="right") - 1, 0)].tolist(),
            gains=self.loop.sensor.gains(outward @ self._R_AtW.T),
        )

    # --- one period ---------------------------------------------------------------------------------------------------

    def _tare(self, stroke: int) -> None:
        """Tare the force sensor, and draw the error of the stroke's zero."""
        self.loop.sensor.tare(self._count)
        self._zero_m = self.loop.zero(stroke)

    def _measure_contact(self) -> ContactMeasurement:
        """Return the contact as measured at the end of the latest period."""
        measured = (self._depth, self._force, self._load, (_NOWHERE, _NOWHERE), self._touching)
        return ContactMeasurement(_NO_ARM, _NOWHERE, _NOWHERE, _FOOT, WallEstimate(0.0, 0.0, self.loop.uncertainty_m), *measured)

    def _period(self, stage: planning.StrokeStage, contact: ContactMeasurement) -> PeriodRow:
        """Move the indenter for a period, with the errors of this examination."""
        motion, loop, patient, path, k = self._motion, self.loop, self.patient, self._path, self._count
        self._count += 1
        in_contact = self._touching and stage is not planning.StrokeStage.LIFT
        motion.regulate(contact, in_contact=in_contact, pushing=stage in planning.PUSHING)
        at = int(motion.along.position * path.per_m + 0.5)
        self._depth = motion.regulation.reference_m + loop.regulation.at(k)
        share = path.breathing[at]
        excursion = patient.tissue.excursion(patient.time + PERIOD_S)
        unseen = (1.0 - loop.followed) * share * (excursion - self._mean_excursion)
        depth = self._depth - path.error_m[at] - self._zero_m - loop.wander.at(k) + unseen
        height = patient.radius - depth + share * excursion
        force = patient.move(path.place[at] + height * path.normal[at])
        self._force = loop.sensor.lagging(float(path.gains[at] @ force)) + loop.sensor.tared_reading(k)
        along = float(path.normal[at] @ force)
        self._load = sqrt(self._force**2 + max(float(force @ force) - along**2, 0.0))
        self._touching = self._force > (THRESHOLDS.off_n if self._touching else THRESHOLDS.on_n)
        self._open = not self._gated or abs(loop.followed * excursion) < WALL.gate_m
        limited = planning.is_limited(stage, motion)
        return PeriodRow(
            time=patient.time,
            path=path,
            at=at,
            stage=stage,
            depth=self._depth,
            setpoint=motion.regulation.reference_m,
            force=self._force,
            followed=loop.followed * share * excursion,
            stroke=self._descent.stroke,
            true_depth=depth,
            true_force=force,
            touching=self._touching,
            steady=self._touching and self._open and planning.is_steady(stage, motion, limited=limited),
            limited=limited,
        )
