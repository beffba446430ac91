"""Files to a `Recording`: reads, cleans, aligns, tares, cuts, finds the skin, and says what was wrong."""

from collections.abc import Sequence
from dataclasses import replace
from operator import attrgetter
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from scipy.ndimage import find_objects, label, median_filter
from scipy.spatial import cKDTree

from palpate.recording.contacts import contacts_of_probes, contacts_over_time, probes
from palpate.recording.mapping import Mapping, MappingError, read_mapping
from palpate.recording.motion import Axis, blocks, pressing_axis
from palpate.recording.readings import TABLES, ReadingError, Readings, from_bag, from_table, move_to_mapped, read_table
from palpate.recording.recording import (
    Contact,
    ContactKind,
    Fault,
    FaultCode,
    Palpated,
    PalpationRecording,
    Remedy,
    implied_young,
    is_refused,
    loading,
    width,
)
from palpate.report.evidence import FILE, columns_of, points, read_evidence, xyz
from palpate_assessment.standard import load_calibration
from palpate_bus.messages import NS, nanoseconds
from palpate_models.numerics.frames import Array, Mask, apply, inverse, matrix
from palpate_models.scenario.load import exam_input, load_scenario


class ReadingLimits(NamedTuple):
    """Limits of plausible readings and contacts."""

    frozen: int = 10
    """A value that repeats this much longer than usual is frozen."""
    min_readings: int = 5
    """Minimum number of readings of a clipped or frozen stretch."""
    clipped: float = 0.2
    """Minimum end of a sensor's range, as a share of the maximum force."""
    clipped_count: float = 3.0
    """A force at the end of the range is at least this many times as frequent as the next one."""
    missing: float = 3.0
    """Distance of a number for missing values from all others, over the size of these."""
    missing_count: int = 3
    """Minimum number of times that it is there."""
    missing_others: int = 10
    """Minimum number of different other values: a raster of two lines has two."""
    spike: float = 0.5
    """Minimum size of a spike of the force, over the range of the force."""
    gap_s: float = 600.0
    """Longest time between rows: longer ones are shortened to it."""
    resolution: float = 0.03
    """Step of the force that is reported, over its range."""
    few_values: int = 40
    coarse: float = 0.2
    """Share of rows with the time of another one from which the clock is too coarse for the rows."""
    disagree: float = 0.35
    """Log ratio of forces at one place that is reported."""
    sure: float = 4.0
    """Minimum depth, in SD of its zero, and minimum force, in SD of its noise."""
    share: float = 0.3
    """Minimum depth, as a share of the usual one."""
    line: float = 0.1
    """Minimum width of the places, over the radius of the footprint, from which on there is a map."""
    rows: int = 10
    risen: float = 0.5
    """Mean way of probes along their normals, over its size, from which the normals point inward."""
    upright: float = 0.7
    """Cosine of the angle between z and outward up to which the frame of the positions is that of the body."""
    doubtful_frame_deg: float = 25.0
    """Angle between force and motion from which the frame is reported as doubtful."""
    wrong_frame_deg: float = 40.0
    """Angle between force and motion from which no map is drawn."""
    force_n: tuple[float, float] = (0.01, 200.0)
    """Change of the force in a recording."""
    young_pa: tuple[float, float] = (50.0, 3e6)
    """Modulus of the body."""
    usual_young_pa: tuple[float, float] = (5e3, 5e5)
    """Modulus of most organs and phantoms."""
    speed_mps: float = 1.0
    """Usual speed of the tool where it moves."""
    step_s: tuple[float, float] = (2e-5, 2.0)
    """Time between rows."""


LIMITS: Final = ReadingLimits()


def clean_readings(readings: Readings, radius: float) -> tuple[Readings, list[Fault]]:
    """Return the readings without invalid, repeated, frozen and displaced ones, clipped ones marked, and the faults."""
    faults: list[Fault] = []
    if readings.probe is not None and 2 * len(np.unique(readings.probe)) < np.count_nonzero(np.diff(readings.probe)):
        readings = readings.part(np.argsort(readings.probe, kind="stable"))  # rows of one probe are apart

    def drop(code: FaultCode, wrong: Mask, value: float = 0.0) -> None:
        nonlocal readings
        if wrong.any():
            faults.append(Fault(code, int(wrong.sum()), len(wrong), Remedy.LEFT_OUT, value))
            readings = readings.part(~wrong)

    missing, value = _missing(np.column_stack((readings.position, readings.force)))
    drop(FaultCode.MISSING, missing, value)
    known = [readings.position, readings.force, readings.normal, readings.touch, readings.time, readings.probe]
    valid = np.all([np.isfinite(v).reshape(len(v), -1).all(axis=1) for v in known if v is not None], axis=0)
    if readings.normal is not None:
        size = np.linalg.norm(readings.normal, axis=1)
        valid &= size > 0.5
        readings = replace(readings, normal=readings.normal / np.maximum(size, 0.5)[:, None])
    drop(FaultCode.INVALID, ~valid)
    if not valid.any():
        return readings, faults
    if readings.time is None:
        rows = np.column_stack((readings.position, readings.force))
        repeated = np.ones(len(rows), bool)
        repeated[np.unique(rows, axis=0, return_index=True)[1]] = False
        drop(FaultCode.REPEATED, repeated)
    else:
        readings = _in_order(readings, readings.time, faults)
        assert readings.time is not None
        drop(FaultCode.REPEATED, np.append(False, np.diff(readings.time) == 0))
        drop(FaultCode.FROZEN, _frozen(readings.force, readings.position))
        away = np.linalg.norm(readings.position - median_filter(readings.position, (5, 1), mode="nearest"), axis=1)
        p = readings.position
        usual, second = (float(np.median(np.linalg.norm(p[k:] - p[:-k], axis=1))) if len(p) > k else 0.0 for k in (1, 2))
        if usual > max(radius, 3 * second):  # every other row is of another tool
            faults.append(Fault(FaultCode.TWO_TOOLS, len(p), len(p), Remedy.REFUSED, usual))
        drop(FaultCode.JUMP, away > max(0.5 * radius, 10 * usual), float(away.max(initial=0.0)))
        spike = np.abs(readings.force - median_filter(readings.force, (5, 1), mode="nearest")).max(axis=1)
        max_spike = LIMITS.spike * float(np.ptp(np.quantile(readings.force, (0.01, 0.99), axis=0), axis=0).max())
        drop(FaultCode.SPIKE, spike > max_spike, float(spike.max(initial=0.0)))
    if (step := _resolution(readings.force)) > LIMITS.resolution * float(np.ptp(readings.force, axis=0).max(initial=0.0)):
        faults.append(Fault(FaultCode.RESOLUTION, 1, 1, Remedy.KEPT, step))
    clipped, limit = _find_clipped(readings.force, readings.position)
    if clipped.any():
        faults.append(Fault(FaultCode.CLIPPED, int(clipped.sum()), len(clipped), Remedy.LEFT_OUT, limit))
    return replace(readings, clipped=clipped), faults


def _in_order(readings: Readings, time: Array, faults: list[Fault]) -> Readings:
    """Return the readings with times that increase in steps of up to `LIMITS.gap_s`; adds faults. `time` is theirs [s], (n,)."""
    late = time < np.maximum.accumulate(time)
    if late.any():
        faults.append(Fault(FaultCode.BACKWARD, int(late.sum()), len(late), Remedy.CORRECTED))
        readings = readings.part(np.argsort(time, kind="stable"))
        time = np.sort(time)
    steps = np.diff(time)
    wide = steps > LIMITS.gap_s
    if 0 < wide.sum() < 0.5 * len(time):
        faults.append(Fault(FaultCode.GAP, int(wide.sum()), len(time), Remedy.CORRECTED, float(steps.max())))
        time = time[0] + np.append(0.0, np.cumsum(np.minimum(steps, LIMITS.gap_s)))
    readings = replace(readings, time=time)
    rows = np.column_stack((readings.position, readings.force))
    at_once = (np.diff(time) == 0) & (np.diff(rows, axis=0) != 0).any(axis=1)
    if at_once.sum() > LIMITS.coarse * len(time):
        faults.append(Fault(FaultCode.COARSE, int(at_once.sum()), len(time), Remedy.CORRECTED))
        readings = replace(readings, time=_spread(time))
    return readings


def _missing(rows: Array) -> tuple[Mask, float]:
    """Return True where a value repeats far outside of all others of its column, as -999 for a missing one, and the last such."""
    missing, found = np.zeros(len(rows), bool), 0.0
    for column in rows.T:
        finite = column[np.isfinite(column)]
        for end in (finite.min(initial=np.inf), finite.max(initial=-np.inf)):
            others, count = finite[finite != end], np.count_nonzero(finite == end)
            if (
                count >= LIMITS.missing_count
                and len(np.unique(others)) >= LIMITS.missing_others
                and (np.abs(end - others).min() > LIMITS.missing * max(np.ptp(others), np.abs(others).max()))
            ):
                missing |= column == end
                found = float(end)
    return missing, found


def _resolution(force: Array) -> float:
    """Return the largest step between the values of a column that has few of them [N]; 0 if none has."""
    values = [np.unique(column) for column in force.T]
    few = [one for one in values if 2 < len(one) < LIMITS.few_values and len(one) < 0.1 * len(force)]
    return max((float(np.median(np.diff(one))) for one in few), default=0.0)


def _spread(time: Array) -> Array:
    """Return times [s] with rows of equal time spread evenly up to the next one, shape (n,)."""
    known, first = np.unique(time, return_index=True)
    end = known[-1] + (float(np.median(np.diff(known))) if len(known) > 1 else 1.0)
    return np.asarray(np.interp(np.arange(len(time)), [*first, len(time)], [*known, end]))


def _runs(same: Mask) -> list[slice]:
    """Return the stretches of equal neighbours, each with the reading that it repeats."""
    return [slice(one.start - 1, one.stop) for (one,) in find_objects(label(same)[0])]


def _frozen(values: Array, others: Array) -> Mask:
    """Return True where a value repeats much longer than usual while the other one changes, shape (n,)."""
    runs = _runs(np.append(False, (np.diff(values, axis=0) == 0).all(axis=1)))
    frozen = np.zeros(len(values), bool)
    if not runs:
        return frozen
    lengths = np.array([one.stop - one.start for one in runs])
    usual = float(np.median(lengths)) if lengths.sum() > 0.5 * len(values) else 1.0  # slower than the rows
    for one in runs:
        changes = (np.diff(others[one], axis=0) != 0).any(axis=1).mean()
        frozen[one] = one.stop - one.start > max(LIMITS.frozen * usual, LIMITS.min_readings) and changes > 0.5
    return frozen


def _find_clipped(force: Array, position: Array) -> tuple[Mask, float]:
    """Return True where a component stays at an extreme while the tool moves, shape (n,), and that force [N].

    An extreme near zero is none, and neither is one that is about as frequent as the next value: that is the sensor's resolution.
    """
    clipped, limit = np.zeros(len(force), bool), 0.0
    still = np.append(False, (np.diff(position, axis=0) == 0).all(axis=1))
    for column in force.T:
        values, counts = np.unique(column, return_counts=True)
        for end, following in ((-1, -2), (0, 1)) if len(values) > 1 else ():
            value = float(values[end])
            if abs(value) < LIMITS.clipped * np.abs(force).max() or counts[end] < LIMITS.clipped_count * counts[following]:
                continue
            runs = _runs(np.append(False, (np.diff(column) == 0) & (column[1:] == value)))
            if any((~still[one]).sum() >= LIMITS.min_readings for one in runs):
                clipped[column == value] = True
                limit = abs(value)
    return clipped, limit


_COLUMNS = np.dtype(
    [("time", "f8"), ("place", "f8", 3), ("normal", "f8", 3), ("depth", "f8"), ("force", "f8"), ("sd", "f8"), ("stroke", "i8")]
)
_values = attrgetter("depth", "normal_force", "depth_uncertainty", "stroke")


def is_own(path: Path) -> bool:
    """Return True for the results folder of a run."""
    return (path / FILE).is_file() and (path / "scenario.yaml").is_file()


def own_recording(folder: Path) -> PalpationRecording:
    """Return the recording of a run: its strokes at depth. Raises UserError."""
    scenario, collected = load_scenario(str(folder / "scenario.yaml")), read_evidence(folder).collected
    X_AW = inverse(np.array(exam_input(scenario).X_WA))
    rows = columns_of(
        (
            (nanoseconds(s.header.stamp) / NS, xyz(s.surface_point), xyz(s.surface_normal), *_values(s))
            for s in collected.exam_states
            if s.steady
        ),
        _COLUMNS,
    )
    place, normal = apply(X_AW, rows["place"]), rows["normal"] @ X_AW[:3, :3].T
    kind = ContactKind.SLIDE if scenario.exam.mode.value == "continuous" else ContactKind.PRESS
    touches = [
        Contact(
            kind=kind,
            position=place[one],
            normal=normal[one],
            depth=rows["depth"][one],
            force=rows["force"][one],
            depth_uncertainty=float(rows["sd"][one].max()),
            force_noise=0.0,
            time=rows["time"][one],
        )
        for stroke in np.unique(rows["stroke"])
        if (one := np.flatnonzero(rows["stroke"] == stroke)).size >= 3
    ]
    surface = np.empty((0, 3)) if collected.surface is None else apply(X_AW, points(collected.surface))
    normals = np.empty((0, 3)) if collected.surface is None else points(collected.surface, "normals") @ X_AW[:3, :3].T
    return PalpationRecording(
        name=scenario.name,
        indenter_radius_m=scenario.robot.indenter_radius_m,
        touches=tuple(touches),
        surface=surface,
        normals=normals,
        X_WA=inverse(X_AW),
        abdomen=True,
        exponent=load_calibration().exponent,
    )


def select_usable(contacts: Sequence[Contact], radius: float, undeep_ones: int, faults: list[Fault]) -> list[Contact]:
    """Return the contacts that can be assessed; adds faults. `undeep_ones`: contacts that are left out already."""
    usual = float(np.median([contact.depth.max() for contact in contacts])) if contacts else 0.0

    def is_deep(contact: Contact) -> bool:
        min_depth = max(LIMITS.sure * contact.depth_uncertainty, LIMITS.share * usual)
        return bool(contact.depth.max() > min_depth and contact.force.max() > LIMITS.sure * contact.force_noise)

    deep_ones = [contact for contact in contacts if is_deep(contact)]
    shallow = undeep_ones + len(contacts) - len(deep_ones)
    if shallow:
        faults.append(Fault(FaultCode.SHALLOW, shallow, undeep_ones + len(contacts), Remedy.LEFT_OUT))
    wrong = _disagreeing(deep_ones, usual, radius)
    if wrong:
        faults.append(Fault(FaultCode.DISAGREE, len(wrong), len(deep_ones), Remedy.LEFT_OUT))
    good = [contact for k, contact in enumerate(deep_ones) if k not in wrong]
    if not good:
        return []
    places = np.concatenate([contact.position[0 if contact.kind is ContactKind.SLIDE else -1 :] for contact in good])
    wide = width(places) / float(np.sqrt(radius * usual))
    if wide < 1:
        faults.append(Fault(FaultCode.LINE, len(good), len(good), Remedy.KEPT if wide > LIMITS.line else Remedy.REFUSED))
    return good if wide > LIMITS.line else []


def _disagreeing(contacts: list[Contact], depth: float, radius: float) -> set[int]:
    """Return the contacts whose force differs from that of others at the same place: all of two, the odd ones of more."""
    still = [k for k, contact in enumerate(contacts) if contact.kind is not ContactKind.SLIDE]
    if len(still) < 2:
        return set()
    places = np.array([contacts[k].position[-1, :2] for k in still])
    force = np.log(np.maximum(loading([contacts[k] for k in still], depth).force, 1e-9))
    wrong: set[int] = set()
    for k, near in enumerate(cKDTree(places).query_ball_point(places, 0.3 * np.sqrt(radius * depth))):
        limit = LIMITS.disagree if len(near) > 2 else 0.5 * LIMITS.disagree
        if len(near) > 1 and abs(force[k] - np.median(force[near])) > limit:
            wrong.add(still[k])
    return wrong


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
    readings, faults = clean_readings(raw, mapping.tool.radius_m)
    readings = move_to_mapped(readings, mapping)
    if len(readings.position) < LIMITS.rows:
        raise ReadingError(f"{name}: {len(readings.position)} usable rows; expected at least {LIMITS.rows}")
    faults += _implausible(readings)
    if is_refused(faults):
        return _without_contacts(name, mapping, faults)
    parts = probes(readings) if readings.time is None else blocks(readings.time)
    if readings.normal is not None and _inward(readings, parts):
        faults.append(Fault(FaultCode.NORMALS, 1, 1, Remedy.CORRECTED))
        readings = replace(readings, normal=-readings.normal)
    known = None if readings.normal is None else readings.normal.mean(axis=0)
    axis = pressing_axis(readings.position, readings.force, parts, known)
    if axis is None:
        raise ReadingError(f"{name}: the force does not change with the motion of the tool; check their columns")
    if axis.angle_deg > LIMITS.wrong_frame_deg:
        return _without_contacts(name, mapping, [*faults, Fault(FaultCode.FRAME, 1, 1, Remedy.REFUSED, axis.angle_deg)])
    if axis.angle_deg > LIMITS.doubtful_frame_deg:
        faults.append(Fault(FaultCode.FRAME, 1, 1, Remedy.KEPT, axis.angle_deg))
    if axis.flipped:
        faults.append(Fault(FaultCode.SIGN, 1, 1, Remedy.CORRECTED))
        readings, axis = replace(readings, force=-readings.force), axis._replace(force=-axis.force)
    if readings.force.shape[1] == 3:
        axis = axis._replace(outward=axis.force)  # more exact: sideways motion does not tilt it
    X_WA = _body_frame(mapping, axis, readings.position)
    in_A = _in_frame(readings, X_WA)
    axis = axis._replace(outward=X_WA[:3, :3].T @ axis.outward)
    lift = mapping.tool.radius_m if mapping.tool.point == "tip" else 0.0
    touch = None if in_A.touch is None else in_A.touch + lift * axis.outward
    in_A = replace(in_A, position=in_A.position + lift * axis.outward, touch=touch)
    palpated = (
        contacts_of_probes(in_A, axis, mapping.tool.radius_m, parts, faults)
        if in_A.time is None
        else contacts_over_time(in_A, axis, mapping, X_WA, faults)
    )
    if palpated.contacts and not is_refused(faults):
        faults += _implausible_force(palpated.contacts, mapping.tool.radius_m)
    touches = [] if is_refused(faults) else select_usable(palpated.contacts, mapping.tool.radius_m, palpated.untold, faults)
    fitted = mapping.body.pose is None and not np.array_equal(X_WA, np.eye(4))
    if (abdomen := mapping.body.anatomy == "abdomen") and fitted:
        faults.append(Fault(FaultCode.ANATOMY, 1, 1, Remedy.NO_ANATOMY))
    surface, normals = palpated.surface(touches) if touches else Palpated().surface(())
    return PalpationRecording(
        name=name,
        indenter_radius_m=mapping.tool.radius_m,
        touches=tuple(touches),
        surface=surface,
        normals=normals,
        X_WA=X_WA,
        faults=tuple(faults),
        abdomen=abdomen and not fitted,
        exponent=palpated.exponent,
    )


def _without_contacts(name: str, mapping: Mapping, faults: list[Fault]) -> PalpationRecording:
    return PalpationRecording(name, mapping.tool.radius_m, faults=tuple(faults))


def _inward(readings: Readings, parts: list[slice]) -> bool:
    """Return True if most probes go along their normals, not against them."""
    p, n = readings.position, readings.normal
    assert n is not None
    start = p if readings.touch is None else readings.touch
    risen = [float(((p[one] - start[one][0]) @ n[one][0]).mean()) for one in parts]
    return readings.time is None and float(np.median(risen)) > LIMITS.risen * float(np.median(np.abs(risen)))


def _implausible(readings: Readings) -> list[Fault]:
    """Return faults of the units of force and time."""
    faults: list[Fault] = []
    low, high = LIMITS.force_n
    force = float(np.quantile(np.linalg.norm(readings.force - np.median(readings.force, axis=0), axis=1), 0.99))
    if not low < force < high:
        faults.append(Fault(FaultCode.FORCE_UNIT, 1, 1, Remedy.REFUSED, force))
    if readings.time is not None:
        step = float(np.median(np.diff(readings.time)))
        if not LIMITS.step_s[0] < step < LIMITS.step_s[1]:
            faults.append(Fault(FaultCode.TIME_UNIT, 1, 1, Remedy.REFUSED, step))
        speed = np.linalg.norm(np.diff(readings.position, axis=0), axis=1) / np.diff(readings.time)
        usual = float(np.median(speed[speed > 0])) if speed.any() else 0.0
        if usual > LIMITS.speed_mps and not faults:
            faults.append(Fault(FaultCode.SPEED, 1, 1, Remedy.REFUSED, usual))
    return faults


def _implausible_force(contacts: Sequence[Contact], radius: float) -> list[Fault]:
    """Return the fault of forces or lengths in another unit: a body that cannot be is refused, one that is rare is a doubt."""
    young, force = implied_young(contacts, radius)
    low, high = LIMITS.young_pa
    if not low < young < high:
        return [Fault(FaultCode.FORCE_UNIT, 1, 1, Remedy.REFUSED, force)]
    low, high = LIMITS.usual_young_pa
    return [] if low < young < high else [Fault(FaultCode.STIFFNESS, 1, 1, Remedy.KEPT, 1e-3 * young)]


def _body_frame(mapping: Mapping, axis: Axis, position: Array) -> Array:
    """Return X_WA: as mapped, that of the positions if its z points outward, or fitted."""
    X = np.eye(4)
    if mapping.body.pose is not None:
        X = matrix(mapping.body.pose)
        if X[:3, 2] @ axis.outward <= 0:
            raise MappingError(f"body.pose: its z axis points into the body; outward is {np.round(axis.outward, 2).tolist()}")
    elif axis.outward[2] < LIMITS.upright:
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
        return None if v is None else v @ R.T + by

    force = readings.force if readings.force.shape[1] == 1 else readings.force @ R.T
    normal, touch = turned(readings.normal), turned(readings.touch, p)
    return replace(readings, position=readings.position @ R.T + p, force=force, normal=normal, touch=touch, rotation=None)
