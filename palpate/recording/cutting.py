"""Cuts readings into contacts: by force and noise over time, by number in a table of probes; finds where each one begins."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_closing, find_objects, label, median_filter
from scipy.signal import find_peaks

from palpate.recording.motion import TUNING
from palpate_models.numerics.frames import Array

POWERS: Final = (1.0, 1.2, 1.4, 1.6, 1.8, 2.0)
"""Powers of depth that the force of loading is compared with."""
HERTZ: Final = 1.5
_FEW: Final = 10
"""Number of loadings from which on the power is fitted."""
_SHORTEST_S: Final = 0.05
_LOADED: Final = 0.95
"""Share of the greatest depth up to which a press loads."""


@dataclass(frozen=True)
class ContactOnset:
    """Begin of a contact by its loading: F = stiffness (s - at)^power."""

    at: float
    """Inward coordinate s at which the force begins [m]."""
    sd: float
    """Its standard error [m]."""
    stiffness: float
    """[N/m^power]"""
    misfit: float
    """RMS of the force that is not explained, over its RMS."""


def onset(inward: Array, force: Array, power: float, sigma: float) -> ContactOnset | None:
    """Return the onset of a loading by weighted regression of F^(1/power) on s; None with too few readings.

    `inward` [m], `force` [N], shape (k,); `sigma`: SD of the force [N].
    """
    rising = force > 2 * sigma
    if rising.sum() < 3 or np.ptp(inward[rising]) <= 0:
        return None
    s, F = inward[rising], force[rising]
    g = F ** (1 / power)
    w = (power * F ** (1 - 1 / power)) ** 2
    middle, mean = np.average(s, weights=w), np.average(g, weights=w)
    spread = float(w @ (s - middle) ** 2)
    slope = float(w @ ((s - middle) * (g - mean))) / spread
    if slope <= 0:
        return None
    at = middle - mean / slope
    rest = F - (slope * np.maximum(s - at, 0)) ** power
    variance = max(float(rest @ rest) / max(len(s) - 2, 1), sigma**2)
    sd = np.sqrt(variance * (1 / w.sum() + (middle - at) ** 2 / spread)) / slope
    return ContactOnset(float(at), float(sd), slope**power, float(np.sqrt(rest @ rest / (F @ F))))


def power_of(loadings: Sequence[tuple[Array, Array]], sigma: float) -> float:
    """Return the power of depth that fits most loadings best; each is inward coordinate [m] and force [N].

    Of few it is that of a sphere on an elastic half-space (Hertz).
    """
    if len(loadings) < _FEW:
        return HERTZ
    chosen = loadings[:: max(1, len(loadings) // 100)]
    misfits = [np.median([o.misfit if (o := onset(s, F, p, sigma)) else 1.0 for s, F in chosen] or [1.0]) for p in POWERS]
    return POWERS[int(np.argmin(misfits))]


@dataclass(frozen=True)
class Cut:
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
    lowest, shape = find_peaks(inward, prominence=0.3 * float(np.median([np.ptp(inward[one]) for one in touching])))
    near = np.zeros(len(time), bool)
    for one in touching:
        near[max(0, one.start - few) : one.stop + few] = True
    usual = float(np.median(shape["prominences"][near[lowest]])) if near[lowest].any() else np.inf
    return Cut(touching, int((~near[lowest] & (shape["prominences"] > 0.5 * usual)).sum()))


def _split(one: slice, at: NDArray[np.intp]) -> list[slice]:
    """Return the parts of a slice between indices."""
    ends = [one.start, *(int(k) for k in at if one.start < k < one.stop), one.stop]
    return [slice(a, b) for a, b in pairwise(ends)]


def loading(inward: Array) -> slice:
    """Return the part of a contact up to its greatest depth; s [m], shape (k,)."""
    deep = inward >= inward[0] + _LOADED * (inward.max() - inward[0])
    return slice(0, int(np.argmax(deep)) + 1)


def before_lift(inward: Array) -> slice:
    """Return the part of a press before it lifts."""
    deep = inward >= inward[0] + _LOADED * (inward.max() - inward[0])
    return slice(0, len(deep) - int(np.argmax(deep[::-1])))


def modulated(force: Array) -> bool:
    """Return True if the force rises and falls by more than its least value, which shows where the skin is; shape (k,)."""
    across = np.count_nonzero(np.diff(force > 0.5 * (force.max() + force.min())))
    return bool(across >= 2 and force.max() > 2 * force.min() > 0)


def windows(lateral: Array, travel: float) -> list[NDArray[np.intp]]:
    """Return the readings of each stretch of `travel` [m] of a path, shape (k, 3)."""
    way = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(lateral, axis=0), axis=1))))
    number = np.floor(way / travel).astype(int)
    return [part for part in np.split(np.arange(len(way)), np.flatnonzero(np.diff(number)) + 1) if len(part) >= 3]


def lateral_travel(position: Array, outward: Array) -> float:
    """Return the extent of a contact across the outward axis [m]."""
    across = position - np.outer(position @ outward, outward)
    return float(np.linalg.norm(across - across[0], axis=1).max())
