"""Scans of persons without physics in time: what each place feels like (`palpate.quick.felt`), read along lines, with errors.

It takes a fraction of a second a person, so that thousands can be had.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.ndimage import gaussian_filter, gaussian_filter1d, map_coordinates

from palpate.quick.felt import HALF_M, PITCH_M, FeltPatient
from palpate_assessment.sampling import ForceSample
from palpate_models.numerics.seeds import generator

FIELD_LENGTH_M: Final = 0.015
"""Correlation length of the surface error that touches leave, as in whole examinations [m]."""


@dataclass(frozen=True)
class ScanErrors:
    """Standard deviations of what a scan gets wrong."""

    stroke_m: float = 0.0
    """Zero of a stroke's depth."""
    field_m: float = 0.0
    """Perceived surface, smooth over FIELD_LENGTH_M."""
    breathing_m: float = 0.0
    """Residual breathing, over 1 s and with its period [m]."""
    tare_n: float = 0.0
    """Zero of a stroke's force."""
    noise_n: float = 0.02
    """Mean force of a sample."""
    depth_m: float = 0.0001
    """Depth of a sample by itself."""


def felt_samples(
    patient: FeltPatient, errors: ScanErrors, seed: int, spacing: float = 0.0125, region: float = 0.2
) -> list[ForceSample]:
    """Samples every 5 mm of lines to and fro over the region at 30 mm/s, each line a stroke of its own."""
    rng = generator(seed, "felt-scan")
    lines = np.linspace(-region / 2, region / 2, round(region / spacing) + 1)
    along = np.arange(-region / 2 + 0.0025, region / 2, 0.005)
    n, conversion, period = rng.normal(1.4, 0.1), rng.normal(-0.008, 0.015), rng.uniform(3.0, 6.0)
    duration = region / 0.03
    times = np.concatenate([i * (duration + 4.0) + np.linspace(0, duration, len(along)) for i in range(len(lines))])
    clock = np.arange(0.0, times[-1] + 0.1, 0.05)
    wander = gaussian_filter1d(rng.standard_normal(len(clock)), 1.0 / np.sqrt(2) / 0.05)
    wander = wander / wander.std() + np.sqrt(2) * np.sin(2 * np.pi * clock / period + rng.uniform(0, 6))
    breathing = errors.breathing_m * np.interp(times, clock, wander) / np.sqrt(2)
    field = gaussian_filter(rng.standard_normal((75, 75)), FIELD_LENGTH_M / np.sqrt(2) / PITCH_M)
    field *= errors.field_m / max(float(field.std()), 1e-12)
    xy = np.concatenate(
        [np.column_stack((along[:: 1 if i % 2 == 0 else -1], np.full(len(along), y))) for i, y in enumerate(lines)]
    )
    stroke = np.repeat(np.arange(len(lines)), len(along))
    zero = errors.stroke_m * rng.standard_normal(len(lines))[stroke]
    zero = zero + map_coordinates(field, ((xy + HALF_M) / PITCH_M).T[::-1], order=1) + breathing
    depth = 0.010 + 0.0002 * rng.standard_normal(len(xy))
    pressed = np.maximum(depth + zero + errors.depth_m * rng.standard_normal(len(xy)), 0.002)
    force = patient.force_at(xy) * np.exp(conversion) * (pressed / 0.010) ** n
    force += errors.tare_n * rng.standard_normal(len(lines))[stroke] + errors.noise_n * rng.standard_normal(len(xy))
    limited = force > 14.0
    speed = np.where(stroke % 2 == 0, 0.03, -0.03)
    unsure = float(np.hypot(errors.stroke_m, errors.field_m) * np.exp(0.3 * rng.standard_normal()))
    return [
        ForceSample(
            time=float(times[i]),
            position=np.array((*xy[i], 0.0)),
            normal=np.array((0.0, 0.0, 1.0)),
            velocity=np.array((speed[i], 0.0, 0.0)),
            depth=float(depth[i]),
            force=float(min(force[i], 15.0)),
            force_noise=errors.noise_n,
            time_in_contact=float(times[i] - times[stroke == stroke[i]][0]),
            force_limited=bool(limited[i]),
            stroke=int(stroke[i]),
            depth_uncertainty=unsure,
        )
        for i in range(len(xy))
    ]
