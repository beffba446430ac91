"""The strokes of an examination, carried out on a patient without an arm.

What is done is planning's: its coverage, its curves and speeds, its regulation of depth against force. What the arm and the eye
get wrong is drawn as whole examinations have it (`palpate.quick.errors`). What comes out is what planning and tissue would have
sent: exam/state, perception/surface and truth/indentation.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from math import sqrt
from typing import Final

import numpy as np

from palpate.quick.errors import Loop
from palpate.quick.patient import PERIOD_S, Patient, seen_lattice
from palpate.truth.surface import TrueBody, TrueSurface
from palpate_models.numerics.frames import Array, apply, inverse
from palpate_models.scenario.load import exam_input
from palpate_models.scenario.patterns import scan_of
from palpate_models.scenario.schema import Following, Mode, Scenario
from palpate_planning.contact import CONTACT_OFF_N, CONTACT_ON_N, ContactMeasurement
from palpate_planning.descent import ALLOWANCE_M, DESCEND_MPS, PROBE_MPS, REST_S, SIGMAS, TARE_S
from palpate_planning.palpation import (
    HOLD_S,
    HOP_M,
    LIFT_MPS,
    SETTLE_MAX_S,
    SETTLED_M,
    SETTLED_S,
    STEADY_FRACTION,
    STOPPED,
)
from palpate_planning.stages import AT_DEPTH, PUSHING, StrokeStage
from palpate_planning.stroke_motion import DEPTH_ACCELERATION, StrokeMotion
from palpate_planning.strokes.coverage import strokes, transfer
from palpate_planning.strokes.path import Ints, SurfacePath, lay
from palpate_planning.strokes.segments import Segment
from palpate_planning.wall.breath import Breath
from palpate_planning.wall.surface import Foot, PerceivedSurface
from palpate_planning.wall.touch import FELT_N
from palpate_planning.wall.wall import Wall, WallPlace
from palpate_planning.wall_watch import GATE_M

_DENSE_M: Final = 0.0003
"""Along a stroke, places are known so far apart: what the indenter travels in a period."""
_DOWN: Final = np.diag((1.0, -1.0, -1.0))
"""The tool's orientation, with its z axis into the body."""
_NO_ARM: Final = np.zeros(7)
_NOWHERE: Final = np.zeros(3)
_FOOT: Final = Foot(_NOWHERE, _NOWHERE, 0.0, _NOWHERE[:2])


@dataclass(frozen=True, eq=False)
class Way:
    """A path on the skin as it is believed to be and as it is: g places, about _DENSE_M apart."""

    segment: Segment
    per_m: float
    """Places a metre of the path."""
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
    wrong_m: list[float]
    """How much too far outward the perceived surface is there [m], g of them."""
    target: list[int]
    """Index of the target reached last, g of them."""
    gains: Array
    """Rows that take a force in that frame to the normal force that is read of it, shape (g, 3)."""


@dataclass
class PeriodRow:
    """One period of an examination."""

    time: float
    way: Way
    at: int
    """Index of the place in its way."""
    stage: StrokeStage
    depth: float
    """Measured [m]."""
    setpoint: float
    """[m]"""
    force: float
    """Measured [N]."""
    followed: float
    """How far the set-point has followed the skin by the breath [m]."""
    stroke: int
    """Number of the latest descent."""
    true_depth: float
    """Against the skin as it breathes [m]."""
    true_force: Array
    """On the sphere [N], shape (3,), in the frame in which the patient truly lies."""
    touching: bool
    steady: bool
    limited: bool


class QuickExamination:
    """One examination of one patient."""

    def __init__(self, scenario: Scenario, loop: Loop) -> None:
        """`loop`: what arm, eye and force sensor of this examination get wrong."""
        self._scenario, self._loop = scenario, loop
        self._exam = scenario.exam
        self._X_WA = np.array(exam_input(scenario).X_WA)
        self.patient = Patient(scenario, time=loop.begin_s)
        """Who is examined."""
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
        self._motion = StrokeMotion(self._exam, scenario.limits, self.patient.radius, PERIOD_S, wall)
        self._unsure_m = SIGMAS * loop.uncertainty_m
        self._gated = self._exam.breathing is Following.GATE
        self._open = True
        self._zero_m = 0.0
        self._force, self._load, self._touching = 0.0, 0.0, False
        self._depth = -HOP_M
        self._count = self._stroke_number = 0

    def run(self) -> list[PeriodRow]:
        """Carries it out: what was measured, and what was true."""
        scan = scan_of(self._exam, self._believed.in_A)
        xy = scan.targets
        rows: list[PeriodRow] = []
        usable = np.ones(len(xy), dtype=bool)
        exam = self._exam
        before: Array | None = None
        for stroke in strokes(xy, scan.line_of_target, usable, scan.joined, exam.mode, exam.spacing_m):
            if before is not None:
                rows += self._travel(self._way(transfer(before, stroke.xy[0]), stroke.targets[:1], contact=False))
            rows += self._stroke(self._way(stroke.xy, stroke.targets, stroke.visits))
            before = stroke.xy[-1]
        return rows

    # --- where the skin is, truly and as it is believed to be ----------------------------------------------------------

    @cached_property
    def perceived(self) -> tuple[Array, Array]:
        """The perceived surface as perception's mesh: points [m] and outward unit normals in world, shape (n, 3)."""
        p, n = self._skin.points(seen_lattice(self._exam))
        seen = np.isfinite(p).all(axis=1)
        p, n = p[seen], n[seen]
        p = p + n * self._loop.wrong(p[:, :2])[:, None]
        return apply(self._X_WA, p), n @ self._X_WA[:3, :3].T

    @property
    def shares(self) -> Array:
        """Share of the breathing excursion at each of these points, as it truly is, shape (n,)."""
        return np.asarray(self._breathing(apply(inverse(self._X_WA), self.perceived[0])[:, :2]))

    @property
    def uncertainty_m(self) -> float:
        """Standard deviation of depth that the examination states [m]."""
        return self._loop.uncertainty_m

    def _way(self, xy: Array, targets: Ints, visits: Ints | None = None, *, contact: bool = True) -> Way:
        s, p, n, R = lay(self._believed, xy, _DOWN)
        visited: Ints = np.zeros(len(targets), dtype=np.int64) if visits is None else visits
        path = SurfacePath(s, p, n, R, np.zeros((len(s), 7)), targets, visited)
        count = max(1, round(path.length / _DENSE_M))
        at = np.linspace(0.0, path.length, count + 1)
        dense = np.column_stack([np.interp(at, s, xy[:, k]) for k in (0, 1)])
        believed, outward = self._believed.at(dense)
        place, normal = self._skin.points(dense + self._loop.aside_m)
        return Way(
            segment=Segment(path, contact=contact),
            per_m=count / path.length if path.length else 0.0,
            believed_W=believed.tolist(),
            outward_W=outward.tolist(),
            place=apply(self._X_AtA, place),
            normal=normal @ self._X_AtA[:3, :3].T,
            breathing=self._breathing(dense + self._loop.aside_m).tolist(),
            wrong_m=self._loop.wrong(dense).tolist(),
            target=targets[np.maximum(np.searchsorted(path.visits, at, side="right") - 1, 0)].tolist(),
            gains=self._loop.gains(outward @ self._R_AtW.T),
        )

    # --- the sequence of a stroke, as `palpate_planning.palpation` has it ------------------------------------------------

    def _stroke(self, way: Way) -> Iterator[PeriodRow]:
        motion, exam = self._motion, self._exam
        motion.start(way.segment)
        for _ in range(round((REST_S + TARE_S) / PERIOD_S)):
            motion.depth.step(-HOP_M, LIFT_MPS)
            yield self._period(way, StrokeStage.REST)
        self._loop.tare(self._count)
        self._stroke_number += 1
        self._zero_m = self._loop.zero(self._stroke_number)
        while self._force < FELT_N and motion.depth.position < exam.depth_m:
            braking = motion.depth.velocity**2 / DEPTH_ACCELERATION
            near = motion.depth.position > -self._unsure_m - ALLOWANCE_M - braking
            motion.depth.step(self._unsure_m + exam.depth_m, PROBE_MPS if near else DESCEND_MPS)
            yield self._period(way, StrokeStage.DESCEND)
        there, stopped = False, 0.0
        while not there and stopped <= SETTLED_S:
            there = motion.deepen()
            stopped = stopped + PERIOD_S if motion.slowdown(0.7, 1.0, 0.0) < STOPPED else 0.0
            yield self._period(way, StrokeStage.DESCEND)
        settled = waited = 0.0
        while settled < SETTLED_S and waited < SETTLE_MAX_S:
            motion.deepen()
            near = abs(motion.regulation.reference - self._depth) < SETTLED_M
            settled, waited = settled + PERIOD_S if near else 0.0, waited + PERIOD_S
            yield self._period(way, StrokeStage.SETTLE)
        if exam.mode is Mode.POINT or not way.segment.path.length:
            held = 0
            while held < round(HOLD_S / PERIOD_S):
                held += self._open
                yield self._period(way, StrokeStage.HOLD)
        else:
            while not (self._open and motion.slide()):
                motion.deepen()
                if not self._open:
                    motion.brake()
                yield self._period(way, StrokeStage.SLIDE)
        while not motion.depth.step(-HOP_M, LIFT_MPS):
            motion.brake()
            yield self._period(way, StrokeStage.LIFT)

    def _travel(self, way: Way) -> Iterator[PeriodRow]:
        self._motion.start(way.segment)
        while not self._motion.travel(way.segment.path.length):
            yield self._period(way, StrokeStage.TRANSFER)

    def _period(self, way: Way, stage: StrokeStage) -> PeriodRow:
        """The indenter follows the motion for a period, with this examination's errors."""
        motion, loop, patient, k = self._motion, self._loop, self.patient, self._count
        self._count += 1
        measured = (self._depth, self._force, self._load, (_NOWHERE, _NOWHERE), self._touching)
        contact = ContactMeasurement(_NO_ARM, _NOWHERE, _NOWHERE, _FOOT, WallPlace(0.0, 0.0, loop.uncertainty_m), *measured)
        motion.regulate(contact, in_contact=self._touching and stage is not StrokeStage.LIFT, pushing=stage in PUSHING)
        at = int(motion.along.position * way.per_m + 0.5)
        self._depth = motion.regulation.reference + loop.regulation(k)
        share = way.breathing[at]
        excursion = patient.tissue.excursion(patient.time + PERIOD_S)
        unseen = (1.0 - loop.followed) * share * (excursion - self._mean_excursion)
        depth = self._depth - way.wrong_m[at] - self._zero_m - loop.wander(k) + unseen
        height = patient.radius - depth + share * excursion
        force = patient.move(way.place[at] + height * way.normal[at])
        self._force = float(way.gains[at] @ force) + loop.tared(k)
        along = float(way.normal[at] @ force)
        self._load = sqrt(self._force**2 + max(float(force @ force) - along**2, 0.0))
        self._touching = self._force > (CONTACT_OFF_N if self._touching else CONTACT_ON_N)
        self._open = not self._gated or abs(loop.followed * excursion) < GATE_M
        limited = motion.regulation.limited or (motion.short_of_depth and stage in AT_DEPTH)
        fast = motion.along.velocity >= STEADY_FRACTION * self._exam.speed_mps or limited
        steady = self._touching and self._open and (stage is StrokeStage.HOLD or (stage is StrokeStage.SLIDE and fast))
        return PeriodRow(
            time=patient.time,
            way=way,
            at=at,
            stage=stage,
            depth=self._depth,
            setpoint=motion.regulation.reference,
            force=self._force,
            followed=loop.followed * share * excursion,
            stroke=self._stroke_number,
            true_depth=depth,
            true_force=force,
            touching=self._touching,
            steady=steady,
            limited=limited,
        )
