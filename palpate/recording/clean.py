"""Leaves out rows that cannot be right, and counts them."""

from dataclasses import replace
from typing import Final

import numpy as np
from scipy.ndimage import find_objects, label, median_filter

from palpate.recording.faults import Fault, FaultCode, Remedy
from palpate.recording.motion import Mask
from palpate.recording.readings import Readings
from palpate_models.numerics.frames import Array

_RUN: Final = 10
"""A value that repeats this much longer than usual is frozen."""
_FEWEST: Final = 5
"""Least number of readings of a clipped or frozen stretch."""
_COARSE: Final = 0.2
"""Share of rows with the time of another one from which the clock is too coarse for the rows."""
_LIMIT: Final = 0.2
"""Least end of a sensor's range, as a share of the greatest force."""
_LIMIT_COUNT: Final = 3.0
"""A force at the end of the range is at least this many times as frequent as the next one."""


def cleaned(readings: Readings, radius: float) -> tuple[Readings, list[Fault]]:
    """Return the readings without invalid, repeated, frozen and displaced ones, clipped ones marked, and the faults."""
    faults: list[Fault] = []
    if readings.probe is not None and 2 * len(np.unique(readings.probe)) < np.count_nonzero(np.diff(readings.probe)):
        readings = readings.part(np.argsort(readings.probe, kind="stable"))  # rows of one probe are apart

    def drop(code: FaultCode, wrong: Mask, value: float = 0.0) -> None:
        nonlocal readings
        if wrong.any():
            faults.append(Fault(code, int(wrong.sum()), len(wrong), Remedy.LEFT_OUT, value))
            readings = readings.part(~wrong)

    known = [readings.position, readings.force, readings.normal, readings.touch, readings.time, readings.probe]
    valid = np.all([np.isfinite(v).reshape(len(v), -1).all(axis=1) for v in known if v is not None], axis=0)
    if readings.normal is not None:
        valid &= np.linalg.norm(readings.normal, axis=1) > 0.5
    drop(FaultCode.INVALID, ~valid)
    if readings.normal is not None:
        readings = replace(readings, normal=readings.normal / np.linalg.norm(readings.normal, axis=1)[:, None])
    if readings.time is None:
        rows = np.column_stack((readings.position, readings.force))
        drop(FaultCode.REPEATED, np.append(False, (np.diff(rows, axis=0) == 0).all(axis=1)))
    else:
        late = readings.time < np.maximum.accumulate(readings.time)
        if late.any():
            faults.append(Fault(FaultCode.BACKWARD, int(late.sum()), len(late), Remedy.CORRECTED))
            readings = readings.part(np.argsort(readings.time, kind="stable"))
        assert readings.time is not None
        if (coarse := _unlike_at_once(readings)) > _COARSE * len(late):
            faults.append(Fault(FaultCode.COARSE, coarse, len(late), Remedy.CORRECTED))
            readings = replace(readings, time=_spread(readings.time))
        assert readings.time is not None
        drop(FaultCode.REPEATED, np.append(False, np.diff(readings.time) == 0))
        drop(FaultCode.FROZEN, _frozen(readings.force, readings.position))
        away = np.linalg.norm(readings.position - median_filter(readings.position, (5, 1), mode="nearest"), axis=1)
        p = readings.position
        usual, second = (float(np.median(np.linalg.norm(p[k:] - p[:-k], axis=1))) if len(p) > k else 0.0 for k in (1, 2))
        if usual > max(radius, 3 * second):  # every other row is of another tool
            faults.append(Fault(FaultCode.TWO_TOOLS, len(p), len(p), Remedy.REFUSED, usual))
        drop(FaultCode.JUMP, away > max(0.5 * radius, 10 * usual), float(away.max(initial=0.0)))
    clipped, limit = _clipped(readings.force, readings.position)
    if clipped.any():
        faults.append(Fault(FaultCode.CLIPPED, int(clipped.sum()), len(clipped), Remedy.LEFT_OUT, limit))
    return replace(readings, clipped=clipped), faults


def _unlike_at_once(readings: Readings) -> int:
    """Return the number of rows that have the time of the row before, but not its values."""
    assert readings.time is not None
    rows = np.column_stack((readings.position, readings.force))
    return int(np.count_nonzero((np.diff(readings.time) == 0) & (np.diff(rows, axis=0) != 0).any(axis=1)))


def _spread(time: Array) -> Array:
    """Return times [s] with rows of equal time spread evenly up to the next one, shape (n,)."""
    known, first = np.unique(time, return_index=True)
    end = known[-1] + (float(np.median(np.diff(known))) if len(known) > 1 else 1.0)
    return np.asarray(np.interp(np.arange(len(time)), [*first, len(time)], [*known, end]))


def _runs(same: Mask) -> list[slice]:
    """Return the stretches of equal neighbours, each with the reading that it repeats."""
    found: list[slice] = [one[0] for one in find_objects(label(same)[0])]
    return [slice(one.start - 1, one.stop) for one in found]


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
        frozen[one] = one.stop - one.start > max(_RUN * usual, _FEWEST) and changes > 0.5
    return frozen


def _clipped(force: Array, position: Array) -> tuple[Mask, float]:
    """Return True where a component stays at an extreme while the tool moves, shape (n,), and that force [N].

    An extreme near zero is none, and neither is one that is about as frequent as the next value: that is the sensor's resolution.
    """
    clipped, limit = np.zeros(len(force), bool), 0.0
    still = np.append(False, (np.diff(position, axis=0) == 0).all(axis=1))
    for column in force.T:
        values, counts = np.unique(column, return_counts=True)
        for end, following in ((-1, -2), (0, 1)) if len(values) > 1 else ():
            value = float(values[end])
            if abs(value) < _LIMIT * np.abs(force).max() or counts[end] < _LIMIT_COUNT * counts[following]:
                continue
            runs = _runs(np.append(False, (np.diff(column) == 0) & (column[1:] == value)))
            if any((~still[one]).sum() >= _FEWEST for one in runs):
                clipped[column == value] = True
                limit = abs(value)
    return clipped, limit
