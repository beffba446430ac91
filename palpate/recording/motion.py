"""Pressing axis, sign, delay, free air and zero of the force of a recording over time, from force and motion together.

In contact the force follows the motion along one axis, dF = -k n (n . dp); in free air it does not. Nothing here depends on
the sensor's range or on the stiffness of the body.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft
from scipy.ndimage import median_filter, percentile_filter

from palpate.recording.readings import Readings
from palpate_models.numerics.frames import Array, Mask

_LEAST_M2: Final = 1e-15
"""Minimum variance of the positions within a part [m^2]."""


class FreeMotionTuning(NamedTuple):
    """Windows and limits of the analysis."""

    block_s: float = 0.25
    """Duration over which force and motion are compared."""
    min_readings: int = 4
    """Readings of a block."""
    free_share: float = 0.2
    """Slope of force against motion in free air, as a share of that in contact."""
    free_around: int = 31
    """Blocks of free air whose level is compared."""
    sigmas: float = 5.0
    """Force that counts as contact, in SD of the force in free air."""
    delay_s: float = 1.0
    """Largest delay that is sought."""
    correlation: float = 0.3
    """Minimum correlation of force and motion at the delay."""
    gain: float = 0.85
    """A delay counts as zero if the correlation without it is at least this share of that with it."""


TUNING: Final = FreeMotionTuning()


def noise(values: Array) -> float:
    """Return the SD of white noise on a smooth series, shape (n,), from its second differences."""
    second = np.diff(values, 2)
    second = second[second != 0]
    return 1.4826 * float(np.median(np.abs(second))) / np.sqrt(6) if len(second) else 0.0


class Axis(NamedTuple):
    """The axis along which a recording presses."""

    outward: Array
    """Unit vector, shape (3,): the tool presses against it."""
    force: Array
    """Unit vector of the force on the tool, shape (3,), by the sign that the recording has."""
    stiffness: float
    """Force by motion, median over blocks [N/m]."""

    @property
    def flipped(self) -> bool:
        """True if the force points inward when the tool presses."""
        return float(self.outward @ self.force) < 0

    @property
    def angle_deg(self) -> float:
        """Angle between force and motion, whatever the sign."""
        return float(np.degrees(np.arccos(min(1.0, abs(float(self.outward @ self.force))))))


def blocks(time: Array) -> list[slice]:
    """Return the blocks of a recording over time."""
    step = float(np.median(np.diff(time)))
    size = max(TUNING.min_readings, round(TUNING.block_s / step))
    return [slice(k, k + size) for k in range(0, len(time) - size + 1, size)]


def pressing_axis(position: Array, force: Array, parts: Sequence[slice], outward: Array | None = None) -> Axis | None:
    """Return the pressing axis; None if force and motion are unrelated. Position (n, 3) [m], force (n, 3) or (n, 1) [N].

    It is the first pair of singular vectors of the regression of force on motion within `parts`. Its side is that of `outward`,
    if that is known; else where motion changes no force; without such motion, where the force is small.
    """
    covariance, motion = np.zeros((force.shape[1], 3)), np.zeros((3, 3))
    variance = np.array([position[one].var(axis=0).sum() for one in parts])
    if not variance.max(initial=0.0) > _LEAST_M2:
        return None
    usual = float(np.median(variance[variance > 0]))
    for one, size in zip(parts, variance, strict=True):
        p, F = position[one] - position[one].mean(axis=0), force[one] - force[one].mean(axis=0)
        weight = 1 / (size + usual)  # a fast motion in free air counts no more than another
        covariance += weight * F.T @ p
        motion += weight * p.T @ p
    if not np.abs(covariance).max() > 0:
        return None
    u, _, v = np.linalg.svd(covariance @ np.linalg.inv(motion + 0.02 * np.trace(motion) * np.eye(3)))
    along, by = v[0], u[:, 0]
    z, f = position @ along, force @ by
    spans = np.array([np.ptp(z[one]) for one in parts])
    slopes = np.array([np.cov(z[one], f[one])[0, 1] / max(z[one].var(ddof=1), 1e-18) for one in parts])
    k = float(np.median(slopes[slopes >= 0.5 * np.average(slopes, weights=spans**2)]))
    middle = np.array([z[one].mean() for one in parts])
    moving = spans > 0.2 * np.median(spans[slopes > 0.5 * k])
    free = moving & (np.abs(slopes) < 0.1 * k)
    pressing = moving & (slopes > 0.5 * k)
    if outward is not None:
        side = float(along @ outward)
    elif pressing.any() and free.sum() >= max(3, 0.05 * moving.sum()):
        side = middle[free].mean() - middle[pressing].mean()
    else:
        size = np.linalg.norm(force, axis=1)
        side = np.median(z[size <= np.quantile(size, 0.3)]) - np.median(z[size >= np.quantile(size, 0.9)])
    outward = along * np.sign(side or 1.0)
    pulls = float(along @ outward) > 0  # the force rises along `by` where the tool moves along `along`
    if force.shape[1] == 1:
        return Axis(outward, outward * (-1 if pulls == (by[0] > 0) else 1), k)
    return Axis(outward, (-by if pulls else by), k)


def delay(time: Array, height: Array, force: Array) -> float:
    """Return the time by which the force lags the motion [s], from the correlation of their rates; 0 if it is not clear.

    `height` [m] and `force` [N] along the outward axis, shape (n,) each.
    """
    step = max(float(np.median(np.diff(time))), 0.002)
    even = np.arange(time[0], time[-1], step)
    inward = np.gradient(np.interp(even, time, -height))
    rise = np.gradient(np.interp(even, time, force))
    changes = np.abs(rise) > max(3 * noise(force), 1e-3 * float(np.abs(rise).max()))
    max_rise = 2 * float(np.median(np.abs(rise[changes]))) if changes.any() else 0.0
    rise = np.where(changes, np.clip(rise, -max_rise, max_rise), 0.0)
    farthest = min(int(TUNING.delay_s / step), len(even) - 1)
    lags = np.arange(-farthest, farthest + 1)
    size = next_fast_len(2 * len(even))

    def correlated(later: Array, earlier: Array) -> Array:
        return np.asarray(irfft(rfft(later, size) * rfft(earlier, size).conj(), size)[lags])

    energy = np.maximum(correlated(changes.astype(float), inward**2), 1e-9 * float(inward @ inward))
    found = correlated(rise, inward) / np.sqrt(energy * float(rise @ rise) + 1e-30)
    best = int(np.argmax(found))
    if found[best] < TUNING.correlation or found[farthest] > TUNING.gain * found[best] or abs(lags[best]) == farthest:
        return 0.0
    return float(lags[best] * step)


def free_air(time: Array, height: Array, force: Array, stiffness: float) -> Mask:
    """Return True where the tool moves in free air, shape (n,): the lowest level of force that does not change with height.

    `height` along the outward axis [m], `force` [N] along it, `stiffness` of the contact [N/m]; (n,) each.
    """
    free = np.zeros(len(time), bool)
    level, moves = [], []
    sigma = noise(force)
    for one in blocks(time):
        z, f = height[one] - height[one].mean(), force[one] - force[one].mean()
        size = float(np.linalg.norm(z))
        flat = TUNING.free_share * stiffness
        if size > 0 and abs(float(z @ f)) / size**2 + 2 * sigma / size < flat and f.std() < max(3 * sigma, flat * z.std()):
            level.append(float(np.median(force[one])))
            moves.append(one)
    if not level:
        return free
    levels = np.array(level)
    width = max(4 * sigma, 0.05 * float(np.quantile(force, 0.98) - levels.min()))
    around = min(TUNING.free_around, len(levels))
    lowest = percentile_filter(levels, 10, around, mode="nearest")  # it may drift
    lowest = median_filter(np.where(levels <= lowest + width, levels, lowest), around, mode="nearest")
    within, above = np.abs(levels - lowest) <= width, (levels > lowest + width) & (levels <= lowest + 3 * width)
    pressed = force - np.interp(time, [time[one].mean() for one in moves], lowest) > 2 * width
    outside = float(np.mean(height[pressed])) if pressed.any() else -np.inf
    chosen = [one for one, free_one in zip(moves, within, strict=True) if free_one and height[one].mean() > outside]
    if len(chosen) < 3 or len(chosen) <= 2 * above.sum():
        return free
    for one in chosen:
        free[one] = True
    return free


def tare(time: Array, force: Array, free: Mask) -> tuple[Array, Array, Array]:
    """Return the force without its zero (n, c), its drift (c,), and its SD in free air (c,), all in newtons.

    The zero at any time is that of the free motion around it.
    """
    at = np.flatnonzero(free)
    groups = np.split(at, np.flatnonzero(np.diff(time[at]) > 2 * TUNING.block_s) + 1)
    middle = np.array([time[g].mean() for g in groups])
    levels = np.array([np.median(force[g], axis=0) for g in groups])
    levels = median_filter(levels, (min(5, len(levels)), 1), mode="nearest")
    tenth = max(1, len(levels) // 10)
    base = np.column_stack([np.interp(time, middle, level) for level in levels.T])
    rest = (force - base)[free]
    spread = 1.4826 * np.median(np.abs(rest - np.median(rest, axis=0)), axis=0)
    return force - base, levels[-tenth:].mean(axis=0) - levels[:tenth].mean(axis=0), np.maximum(spread, 1e-4)


def delay_force(readings: Readings, by: float) -> Readings:
    """Return the readings with the force taken `by` [s] later."""
    assert readings.time is not None
    t = readings.time
    columns = [np.interp(t + by, t, column) for column in readings.force.T]
    return replace(readings, force=np.column_stack(columns))
