"""Cuts readings into contacts: by force and noise over time, by number in a table of probes; finds where each one begins."""

from collections.abc import Sequence
from itertools import pairwise
from typing import Final, NamedTuple

import numpy as np
from scipy.ndimage import binary_closing, find_objects, label, median_filter
from scipy.signal import find_peaks

from palpate.recording.motion import TUNING
from palpate_models.numerics.frames import Array, Indices, path_length

POWERS: Final = (1.0, 1.2, 1.4, 1.6, 1.8, 2.0)
"""Powers of depth that the force of loading is compared with."""
HERTZ: Final = 1.5
_FEW: Final = 10
"""Number of loadings from which on the power is fitted."""
_CYCLES: Final = 5
"""Minimum number of cycles of a slide that pushes in and out."""
FOOTPRINT_SHARE: Final = 0.4
"""Share of the footprint's radius over which readings of a slide count as one place."""
_SHORTEST_S: Final = 0.05
_LOADED: Final = 0.95
"""Share of the maximum depth up to which a press loads."""


class ContactOnset(NamedTuple):
    """Begin of a contact by its loading: F = stiffness (s - at - slope along)^power."""

    at: float
    """Inward coordinate s at which the force begins [m]."""
    sd: float
    """Its standard error [m]."""
    slope: float
    """Rise of the skin along the path of the tool [1]."""
    misfit: float
    """RMS of the force that is not explained, over its RMS."""


Loaded = tuple[Array, Array] | tuple[Array, Array, Array]
"""Inward coordinate s [m] and force [N] of a loading, and where the tool slides its coordinate along the path [m]; shape (k,)."""


def onset(load: Loaded, power: float, sigma: float) -> ContactOnset | None:
    """Return the onset of a loading by weighted regression of F^(1/power) on s; None with too few readings.

    `sigma`: SD of the force [N].
    """
    rising = load[1] > 2 * sigma
    s, F, *along = (values[rising] for values in load)
    terms = np.column_stack((np.ones(len(s)), s, *along))
    if len(s) < terms.shape[1] + 1 or np.ptp(s) <= 0:
        return None
    middle = terms.mean(axis=0) * np.arange(terms.shape[1]).clip(max=1)
    terms = terms - middle
    g = F ** (1 / power)
    w = power * F ** (1 - 1 / power)
    found, _, rank, _ = np.linalg.lstsq(terms * w[:, None], g * w, rcond=None)
    steepness = float(found[1])
    if rank < len(found) or steepness <= 0:
        return None
    rest = F - np.maximum(terms @ found, 0) ** power
    covariance = np.linalg.inv((terms * w[:, None]).T @ (terms * w[:, None]))
    covariance *= max(float(rest @ rest) / max(len(s) - len(found), 1), sigma**2)
    slope = -float(found[2]) / steepness if along else 0.0
    back = -float(found[0]) / steepness  # from the mean s to the skin
    pull = np.zeros(len(found))
    pull[:2] = 1.0, back
    return ContactOnset(
        at=float(middle[1]) + back - (slope * float(middle[2]) if along else 0.0),
        sd=float(np.sqrt(pull @ covariance @ pull)) / steepness,
        slope=slope,
        misfit=float(np.sqrt(rest @ rest / (F @ F))),
    )


def power_of(loads: Sequence[Loaded], sigma: float) -> float:
    """Return the power of depth that fits most loadings best.

    Of few it is that of a sphere on an elastic half-space (Hertz).
    """
    if len(loads) < _FEW:
        return HERTZ
    chosen = loads[:: max(1, len(loads) // 100)]
    misfits = [np.median([found.misfit if (found := onset(load, p, sigma)) else 1.0 for load in chosen]) for p in POWERS]
    return POWERS[int(np.argmin(misfits))]


class Cut(NamedTuple):
    """The contacts of a recording over time."""

    touching: list[slice]
    blind: int
    """Descents that touched nothing."""


def cut(time: Array, height: Array, force: Array, sigma: float) -> Cut:
    """Return the contacts of a recording: `height` [m] and tared `force` [N] along the outward axis, shape (n,) each."""
    step = float(np.median(np.diff(time)))
    few = max(3, round(_SHORTEST_S / step))
    limit = TUNING.sigmas * sigma
    smooth = median_filter(force, size=min(few, 9) | 1)
    numbered, _ = label(binary_closing(np.pad(smooth > limit, few), np.ones(few, bool))[few:-few])
    gaps = np.flatnonzero(np.diff(time) > max(TUNING.block_s, 5 * step)) + 1
    found = [part for one in find_objects(numbered) for part in _split(one[0], gaps)]
    touching = [one for one in found if one.stop - one.start >= few and smooth[one].max() > 2 * limit]
    if not touching:
        return Cut([], 0)
    inward = -height
    lowest, rise = peaks(inward, 0.3 * float(np.median([np.ptp(inward[one]) for one in touching])))
    near = np.zeros(len(time), bool)
    for one in touching:
        near[max(0, one.start - few) : one.stop + few] = True
    usual = float(np.median(rise[near[lowest]])) if near[lowest].any() else np.inf
    return Cut(touching, int((~near[lowest] & (rise > 0.5 * usual)).sum()))


def peaks(values: Array, min_rise: float) -> tuple[Indices, Array]:
    """Return the maxima that rise by `min_rise` over the minima on both sides: their indices, and the lesser rise; shape (k,)."""
    at, found = find_peaks(values, prominence=min_rise)
    return at, found["prominences"]


def _split(one: slice, at: Indices) -> list[slice]:
    """Return the parts of a slice between indices."""
    ends = [one.start, *(int(k) for k in at if one.start < k < one.stop), one.stop]
    return [slice(a, b) for a, b in pairwise(ends)]


def loading(inward: Array) -> slice:
    """Return the part of a contact up to its maximum depth; s [m], shape (k,)."""
    deep = inward >= inward[0] + _LOADED * (inward.max() - inward[0])
    return slice(0, int(np.argmax(deep)) + 1)


def before_lift(inward: Array) -> slice:
    """Return the part of a press before it lifts."""
    deep = inward >= inward[0] + _LOADED * (inward.max() - inward[0])
    return slice(0, len(deep) - int(np.argmax(deep[::-1])))


def cycles(position: Array, inward: Array, force: Array, radius: float) -> list[slice]:
    """Return the stretches of a slide that pushes in and out: whole cycles, from one minimum of the force to the next.

    A stretch is about as long as `FOOTPRINT_SHARE` of the footprint of a cycle. There is none if the force does not rise and fall
    by more than its minimum within a footprint of the path. Position [m], shape (k, 3); `inward` [m], `force` [N], (k,).
    """
    low, high = np.quantile(force, (0.05, 0.95))
    troughs, _ = peaks(-force, 0.5 * (high - low))
    way = path_length(position)
    cycle = [slice(int(a), int(b) + 1) for a, b in pairwise(troughs) if b - a >= _FEW]
    if len(cycle) < _CYCLES or high < 2 * low:
        return []
    footprint = np.sqrt(radius * min(float(np.median([np.ptp(inward[one]) for one in cycle])), radius))
    if np.median(np.diff(way[troughs])) > footprint:
        return []
    usual = float(np.median([way[one.stop - 1] - way[one.start] for one in cycle]))
    together = max(1, round(FOOTPRINT_SHARE * footprint / usual))
    parts = [cycle[k : k + together] for k in range(0, len(cycle), together)]
    return [slice(part[0].start, part[-1].stop) for part in parts]


def windows(lateral: Array, travel: float) -> list[Indices]:
    """Return the readings of each stretch of `travel` [m] of a path, shape (k, 3)."""
    number = np.floor(path_length(lateral) / travel).astype(int)
    return [part for part in np.split(np.arange(len(number)), np.flatnonzero(np.diff(number)) + 1) if len(part) >= 3]


def across(position: Array, outward: Array) -> Array:
    """Return positions without their part along the outward axis [m], shape (k, 3)."""
    return np.asarray(position - np.outer(position @ outward, outward))


def lateral_travel(position: Array, outward: Array) -> float:
    """Return the extent of a contact across the outward axis [m]."""
    return float(np.linalg.norm(across(position - position[0], outward), axis=1).max())
