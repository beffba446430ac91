"""An examination on a patient as the messages that planning, perception and tissue of a whole one would have sent."""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from palpate.quick.examination import QuickExamination, Row
from palpate_bus.messages import ExamState, IndentationTruth, PhantomTruth, Point, SurfaceMesh, Vector3
from palpate_bus.messages.geometry import pose_message
from palpate_bus.messages.stamps import NS, header
from palpate_conductor.collector import Collected
from palpate_models.frames import apply
from palpate_planning.status import PHASE_OF

LEAVES_S: Final = 1.0
"""From the last stroke until the assessment is asked for its findings."""
_NO_TRIANGLES: Final = np.empty(0, np.uint32)
_NO_SHARES: Final = np.empty(0, np.float32)


def collected(examination: QuickExamination, rows: list[Row]) -> Collected:
    """What a conductor would have collected of it before the assessment. The last state is in phase ASSESS."""
    X_WA = examination.patient.X_WA
    model = examination.patient.tissue.model
    sigma = examination.uncertainty_m
    states = [_state(row, int(PHASE_OF[row.stage]), row.time, sigma) for row in rows]
    states.append(_state(rows[-1], ExamState.PHASE_ASSESS, rows[-1].time + LEAVES_S, sigma))
    places = apply(X_WA, np.array([row.way.place[row.at] for row in rows])).tolist()
    stiffness = examination.patient.stiffness(np.array([row.way.place[row.at, :2] for row in rows])).tolist()
    true = [_indentation(row, p, k) for row, p, k in zip(rows, places, stiffness, strict=True)]
    skin, normals = (a.astype(np.float32).ravel() for a in (model.vertices, model.normals))
    rest = SurfaceMesh(header(0, "abdomen"), skin, normals, model.triangles.astype(np.uint32).ravel(), _NO_SHARES)
    pose = pose_message(X_WA[:3, :3], X_WA[:3, 3])
    seen_vertices, seen_normals = (a.astype(np.float32).ravel() for a in examination.perceived)
    return Collected(
        exam_states=states,
        indentation=true,
        exam_time=round(rows[-1].time * NS),
        phantom=PhantomTruth(rest, model.stiffness, model.background, model.lesion, pose),
        surface=SurfaceMesh(
            header(0, "world"), seen_vertices, seen_normals, _NO_TRIANGLES, examination.shares.astype(np.float32)
        ),
    )


def _state(row: Row, phase: int, time: float, sigma: float) -> Any:
    """`exam/state`."""
    over = phase == ExamState.PHASE_ASSESS
    return ExamState(
        header=header(round(time * NS), "world"),
        phase=phase,
        message="",
        target_index=row.way.target[row.at],
        target_count=0,
        targets_skipped=0,
        in_contact=row.touching and not over,
        steady=row.steady and not over,
        force_limited=row.limited,
        view_blocked=False,
        depth_setpoint=row.setpoint,
        depth=row.depth,
        normal_force=row.force,
        surface_point=Point(*row.way.believed_W[row.at].tolist()),
        surface_normal=Vector3(*row.way.outward_W[row.at].tolist()),
        end_tick=-1,
        depth_uncertainty=sigma,
        wall_displacement=row.followed,
        stroke=row.stroke,
        patient_moved=False,
    )


def _indentation(row: Row, p_W: list[float], stiffness: float) -> Any:
    """`truth/indentation`."""
    F = row.true_force
    normal = float(F @ row.way.normal[row.at])
    size = float(np.sqrt(F @ F))
    return IndentationTruth(
        header=header(round(row.time * NS), "world"),
        depth=row.true_depth,
        normal_force=max(normal, 0.0),
        tangential_force=float(np.sqrt(max(size * size - normal * normal, 0.0))),
        peak_force=size,
        contacts=0,
        surface_point=Point(*p_W),
        stiffness=stiffness,
    )
