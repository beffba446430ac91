"""Messages of planning, perception and tissue for an examination without an arm."""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from palpate.exam_state import exam_state
from palpate.quick.examination import PeriodRow, QuickExamination
from palpate.quick.patient import Patient
from palpate_bus.messages import ExamState, IndentationTruth, PhantomTruth, Point, SurfaceMesh
from palpate_bus.messages.geometry import pose_message
from palpate_bus.messages.stamps import NS, header
from palpate_conductor.collector import Collected
from palpate_models.numerics.frames import apply
from palpate_planning.status import PHASE_OF

LEAVES_S: Final = 1.0
"""Time from the last stroke to the request for findings."""
_NO_TRIANGLES: Final = np.empty(0, np.uint32)
_NO_SHARES: Final = np.empty(0, np.float32)


def collected(examination: QuickExamination, rows: list[PeriodRow]) -> Collected:
    """Return what a conductor would have collected before the assessment. The last state is in phase ASSESS."""
    X_WA = examination.patient.X_WA
    model = examination.patient.tissue.model
    sigma = examination.uncertainty_m
    phases = {stage: int(PHASE_OF[stage]) for stage in {row.stage for row in rows}}
    states = [_state(row, phases[row.stage], row.time, sigma) for row in rows]
    states.append(_state(rows[-1], ExamState.PHASE_ASSESS, rows[-1].time + LEAVES_S, sigma))
    skin, normals = (a.astype(np.float32).ravel() for a in (model.vertices, model.normals))
    rest = SurfaceMesh(header(0, "abdomen"), skin, normals, model.triangles.astype(np.uint32).ravel(), _NO_SHARES)
    pose = pose_message(X_WA[:3, :3], X_WA[:3, 3])
    seen_vertices, seen_normals = (a.astype(np.float32).ravel() for a in examination.perceived)
    return Collected(
        exam_states=states,
        indentation=_indentations(examination.patient, rows),
        exam_time=round(rows[-1].time * NS),
        phantom=PhantomTruth(rest, model.stiffness, model.background, model.lesion, pose),
        surface=SurfaceMesh(
            header(0, "world"), seen_vertices, seen_normals, _NO_TRIANGLES, examination.shares.astype(np.float32)
        ),
    )


def _state(row: PeriodRow, phase: int, time: float, sigma: float) -> Any:
    """Return `exam/state` of a period."""
    over = phase == ExamState.PHASE_ASSESS
    return exam_state(
        round(time * NS),
        phase,
        row.path.believed_W[row.at],
        row.path.outward_W[row.at],
        target_index=row.path.target[row.at],
        in_contact=row.touching and not over,
        steady=row.steady and not over,
        force_limited=row.limited,
        depth_setpoint=row.setpoint,
        depth=row.depth,
        normal_force=row.force,
        depth_uncertainty=sigma,
        wall_displacement=row.followed,
        stroke=row.stroke,
    )


def _indentations(patient: Patient, rows: list[PeriodRow]) -> list[Any]:
    """Return `truth/indentation` of every period."""
    place = np.array([row.path.place[row.at] for row in rows])
    outward = np.array([row.path.normal[row.at] for row in rows])
    F = np.array([row.true_force for row in rows])
    normal, size = (F * outward).sum(axis=1), np.linalg.norm(F, axis=1)
    columns = (
        apply(patient.X_WA, place),
        np.maximum(normal, 0.0),
        np.sqrt(np.maximum(size**2 - normal**2, 0.0)),
        size,
        patient.stiffness(place[:, :2]),
    )
    return [
        IndentationTruth(
            header=header(round(row.time * NS), "world"),
            depth=row.true_depth,
            normal_force=along,
            tangential_force=across,
            peak_force=peak,
            contacts=0,
            surface_point=Point(*p_W),
            stiffness=stiffness,
        )
        for row, p_W, along, across, peak, stiffness in zip(rows, *(column.tolist() for column in columns), strict=True)
    ]
