"""Files to a `Recording`: reads, cleans, aligns, tares, cuts, finds the skin, and says what was wrong."""

from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from palpate.recording.clean import cleaned
from palpate.recording.faults import Fault, FaultCode, Remedy
from palpate.recording.mapping import Mapping, MappingError, read_mapping
from palpate.recording.motion import Axis, blocks, pressing_axis
from palpate.recording.own import is_own, own_recording
from palpate.recording.probes import contacts_of_probes, probes
from palpate.recording.readings import TABLES, ReadingError, Readings, from_bag, from_table, moved, read_table
from palpate.recording.recording import Contact, PalpationRecording, implied_young
from palpate.recording.timed import contacts_over_time
from palpate.recording.usable import usable
from palpate_models.numerics.frames import Array, inverse, matrix

LEAST_ROWS: Final = 10
_UPRIGHT: Final = 0.7
"""Cosine of the angle between z and outward up to which the frame of the positions is that of the body."""
_RISEN: Final = 0.5
"""Mean way of probes along their normals, over its size, from which the normals point inward."""
_WRONG_FRAME_DEG: Final = 40.0
_FORCE_N: Final = (0.01, 200.0)
"""Plausible change of the force in a recording."""
_YOUNG_PA: Final = (50.0, 3e6)
"""Plausible modulus of the body."""
_STEP_S: Final = (2e-5, 2.0)
"""Plausible time between rows."""


def read_recording(path: str | Path, mapping: Mapping | str | Path | None = None) -> PalpationRecording:
    """Return the recording of a table, a bag, or the results folder of a run.

    Parameters
    ----------
    path
        CSV, Parquet, MCAP, a rosbag2 folder, or the results folder of `palpate run`.
    mapping
        What its columns or topics are, as an object or a YAML file; none for the results of a run.

    Raises
    ------
    UserError
        The file or the mapping cannot be used.
    """
    path = Path(path)
    if not path.exists():
        raise ReadingError(f"{path}: is not there")
    if mapping is None:
        if is_own(path):
            return own_recording(path)
        raise MappingError(f"{path}: --mapping is missing; palpate assess {path} --inspect --out mapping.yaml proposes one")
    mapping = mapping if isinstance(mapping, Mapping) else read_mapping(Path(mapping))
    if (mapping.table is not None) != (path.suffix in TABLES):
        raise MappingError(f"{path}: the mapping has {'table' if mapping.table else 'topics'}, which does not fit this file")
    raw = from_table(read_table(path), mapping, str(path)) if mapping.table else from_bag(path, mapping)
    return recording_of(raw, mapping, path.stem)


def recording_of(raw: Readings, mapping: Mapping, name: str) -> PalpationRecording:
    """Return the recording of readings as a file has them. Raises UserError."""
    readings, faults = cleaned(raw, mapping.tool.radius_m)
    readings = moved(readings, mapping)
    if len(readings.position) < LEAST_ROWS:
        raise ReadingError(f"{name}: {len(readings.position)} usable rows; want at least {LEAST_ROWS}")
    faults += _implausible(readings)
    if any(fault.remedy is Remedy.REFUSED for fault in faults):
        return _refused(name, mapping, faults)
    parts = probes(readings) if readings.time is None else blocks(readings.time)
    if readings.normal is not None and _inward(readings, parts):
        faults.append(Fault(FaultCode.NORMALS, 1, 1, Remedy.CORRECTED))
        readings = replace(readings, normal=-readings.normal)
    known = None if readings.normal is None else readings.normal.mean(axis=0)
    axis = pressing_axis(readings.position, readings.force, parts, known)
    if axis is None:
        raise ReadingError(
            f"{name}: the force does not change with the motion of the tool; check the columns of position and force"
        )
    if axis.angle_deg > _WRONG_FRAME_DEG:
        return _refused(name, mapping, [*faults, Fault(FaultCode.FRAME, 1, 1, Remedy.REFUSED, axis.angle_deg)])
    if axis.flipped:
        faults.append(Fault(FaultCode.SIGN, 1, 1, Remedy.CORRECTED))
        readings, axis = replace(readings, force=-readings.force), replace(axis, force=-axis.force)
    if readings.force.shape[1] == 3:
        axis = replace(axis, outward=axis.force)  # more exact: sideways motion does not tilt it
    X_WA = _body_frame(mapping, axis, readings.position)
    in_A = _in_frame(readings, X_WA)
    axis = replace(axis, outward=X_WA[:3, :3].T @ axis.outward)
    lift = mapping.tool.radius_m if mapping.tool.point == "tip" else 0.0
    touch = None if in_A.touch is None else in_A.touch + lift * axis.outward
    in_A = replace(in_A, position=in_A.position + lift * axis.outward, touch=touch)
    palpated = (
        contacts_of_probes(in_A, axis, mapping.tool.radius_m, parts, faults)
        if in_A.time is None
        else contacts_over_time(in_A, axis, mapping, X_WA, faults)
    )
    if palpated.contacts and not any(fault.remedy is Remedy.REFUSED for fault in faults):
        faults += _implausible_force(palpated.contacts, mapping.tool.radius_m)
    touches = (
        []
        if any(fault.remedy is Remedy.REFUSED for fault in faults)
        else usable(palpated.contacts, mapping.tool.radius_m, palpated.untold, faults)
    )
    return PalpationRecording(
        name=name,
        indenter_radius_m=mapping.tool.radius_m,
        touches=tuple(touches),
        surface=palpated.surface,
        normals=palpated.normals,
        X_WA=X_WA,
        faults=tuple(faults),
        abdomen=mapping.body.anatomy == "abdomen",
        exponent=palpated.exponent,
    )


def _refused(name: str, mapping: Mapping, faults: list[Fault]) -> PalpationRecording:
    return PalpationRecording(name, mapping.tool.radius_m, (), np.empty((0, 3)), np.empty((0, 3)), faults=tuple(faults))


def _inward(readings: Readings, parts: list[slice]) -> bool:
    """Return True if most probes go along their normals, not against them."""
    p, n = readings.position, readings.normal
    assert n is not None
    start = p if readings.touch is None else readings.touch
    risen = [float(((p[one] - start[one][0]) @ n[one][0]).mean()) for one in parts]
    return readings.time is None and float(np.median(risen)) > _RISEN * float(np.median(np.abs(risen)))


def _implausible(readings: Readings) -> list[Fault]:
    """Return faults of the units of force and time."""
    faults: list[Fault] = []
    low, high = _FORCE_N
    force = float(np.quantile(np.linalg.norm(readings.force - np.median(readings.force, axis=0), axis=1), 0.99))
    if not low < force < high:
        faults.append(Fault(FaultCode.FORCE_UNIT, 1, 1, Remedy.REFUSED, force))
    if readings.time is not None:
        step = float(np.median(np.diff(readings.time)))
        if not _STEP_S[0] < step < _STEP_S[1]:
            faults.append(Fault(FaultCode.TIME_UNIT, 1, 1, Remedy.REFUSED, step))
    return faults


def _implausible_force(contacts: list[Contact], radius: float) -> list[Fault]:
    """Return the fault of forces in another unit."""
    (low, high), (young, force) = _YOUNG_PA, implied_young(contacts, radius)
    return [] if low < young < high else [Fault(FaultCode.FORCE_UNIT, 1, 1, Remedy.REFUSED, force)]


def _body_frame(mapping: Mapping, axis: Axis, position: Array) -> Array:
    """Return X_WA: as mapped, that of the positions if its z points outward, or fitted."""
    X = np.eye(4)
    if mapping.body.pose is not None:
        X = matrix(mapping.body.pose)
        if X[:3, 2] @ axis.outward <= 0:
            raise MappingError(f"body.pose: its z axis points into the body; outward is {np.round(axis.outward, 2).tolist()}")
    elif axis.outward[2] < _UPRIGHT:
        side = np.eye(3)[np.argmin(np.abs(axis.outward))]
        y = np.cross(axis.outward, side)
        y /= np.linalg.norm(y)
        X[:3, :3] = np.column_stack((np.cross(y, axis.outward), y, axis.outward))
        X[:3, 3] = position.mean(axis=0)
    return X


def _in_frame(readings: Readings, X_WA: Array) -> Readings:
    X_AW = inverse(X_WA)
    R, p = X_AW[:3, :3], X_AW[:3, 3]

    def turned(v: Array | None, by: Array | float = 0.0) -> Array | None:
        return None if v is None or v.shape[1] == 1 else v @ R.T + by

    force = readings.force if readings.force.shape[1] == 1 else readings.force @ R.T
    return replace(
        readings,
        position=readings.position @ R.T + p,
        force=force,
        normal=turned(readings.normal),
        touch=turned(readings.touch, p),
        rotation=None,
    )
