"""Scans of persons without physics in time: what an indenter feels of each place, read along lines, with errors.

A place's force follows from the wall's stiffness and stiffening there (`force_at_10_mm`) and is averaged over the indenter's
footprint on a Winkler-Pasternak foundation. It takes a fraction of a second a person, so that thousands can be had, for the
calibration of the assessment's probabilities.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from scipy.interpolate import LinearNDInterpolator
from scipy.ndimage import gaussian_filter, gaussian_filter1d, map_coordinates
from scipy.signal import fftconvolve
from scipy.special import k0, k1

from palpate_assessment.sampling import ForceSample
from palpate_models.frames import Array
from palpate_models.patient import Phantom
from palpate_models.person import drawn
from palpate_models.phantom import build_phantom
from palpate_models.seeds import generator
from palpate_validation.persons import force_at_10_mm

PITCH_M: Final = 0.004
HALF_M: Final = 0.148
"""Half the side of the square in which the wall is known."""
CONTACT_M: Final = 0.009
"""Radius of the contact of a sphere of 15 mm at 10 mm depth [C, of the foundation's obstacle problem]."""
POWER: Final = 0.8
"""A wall that gives way beside a stiff place makes the mean over the footprint a power mean of this exponent [C, transients]."""


@dataclass(frozen=True)
class FeltPatient:
    """What the standard press feels of a person, by the footprint's mean, on a square grid about the umbilicus; n x n places."""

    force: Array
    """[N], shape (n, n), rows along y."""
    healthy: Array
    """The same without lumps."""

    def force_at(self, xy: Array) -> Array:
        """Force [N] at places [m], shape (m, 2) -> (m,)."""
        return np.asarray(map_coordinates(self.force, ((xy + HALF_M) / PITCH_M).T[::-1], order=1))

    def excess_at(self, xy: Array) -> Array:
        """The logarithm of the felt contrast of all lumps at places [m], shape (m, 2) -> (m,)."""
        excess = np.log(self.force / self.healthy)
        return np.asarray(map_coordinates(excess, ((xy + HALF_M) / PITCH_M).T[::-1], order=1))


@dataclass(frozen=True)
class ScanErrors:
    """Standard deviations of what a scan gets wrong."""

    stroke_m: float = 0.0
    """Zero of a stroke's depth."""
    field_m: float = 0.0
    """Perceived surface, smooth over 50 mm."""
    breathing_m: float = 0.0
    """What is left of breathing, over 1 s and with its period."""
    tare_n: float = 0.0
    """Zero of a stroke's force."""
    noise_n: float = 0.02
    """Mean force of a sample."""
    depth_m: float = 0.0001
    """Depth of a sample by itself."""


def felt_patient(phantom: Phantom, seed: int) -> FeltPatient:
    """The person of a seed with the lumps that the phantom draws or has."""
    phantom = drawn(phantom, seed)
    model = build_phantom(phantom, seed)
    axis = np.arange(-HALF_M, HALF_M + 1e-9, PITCH_M)
    footprint = _footprint(phantom.stiffness.length_m)
    front = (model.normals[:, 2] > 0.2) & (np.abs(model.vertices[:, :2]) < 1.2 * HALF_M).all(axis=1)
    xy = np.stack(np.meshgrid(axis, axis), axis=-1)

    def felt(modulus: Array) -> Array:
        force = force_at_10_mm(replace(model, stiffness=modulus), phantom.stiffness) * (1 + 0.4 * model.tension)
        raster = np.nan_to_num(
            LinearNDInterpolator(model.vertices[front, :2], np.log(force[front]))(xy), nan=float(np.log(np.median(force[front])))
        )
        padded = np.pad(np.exp(POWER * raster), len(footprint) // 2, mode="edge")
        return np.asarray(fftconvolve(padded, footprint, mode="valid") ** (1 / POWER))

    return FeltPatient(felt(model.stiffness), felt(model.background))


def _footprint(length: float) -> Array:
    """Sensitivity of the force to the modulus about the indenter, on the grid, summing to 1.

    By the envelope theorem dF = dk_w (u phi + l^2 grad u . grad phi) with the influence phi = K0(r / l) / K0(a / l)
    beyond the contact.
    """
    reach = min(round(3 * length / PITCH_M) + 3, 15)
    axis = np.arange(-reach, reach + 1) * PITCH_M
    r = np.hypot(*np.meshgrid(axis, axis))
    a = CONTACT_M
    beyond = np.maximum(r, a) / length
    edge = 0.010 - 0.015 + np.sqrt(0.015**2 - a**2)
    outside = edge * (k0(beyond) ** 2 + k1(beyond) ** 2) / k0(a / length) ** 2
    inside = 0.010 - 0.015 + np.sqrt(0.015**2 - np.minimum(r, a) ** 2)
    footprint = gaussian_filter(np.where(r < a, inside, outside), 0.5)
    return np.asarray(footprint / footprint.sum())


def felt_samples(
    patient: FeltPatient, errors: ScanErrors, seed: int, spacing: float = 0.0125, region: float = 0.2
) -> list[ForceSample]:
    """Samples every 5 mm of lines to and fro over the region at 30 mm/s, each line a stroke of its own."""
    rng = generator(seed, "felt-scan")
    lines = np.linspace(-region / 2, region / 2, round(region / spacing) + 1)
    along = np.arange(-region / 2 + 0.0025, region / 2, 0.005)
    n, conversion, period = rng.normal(1.35, 0.1), rng.normal(0.0, 0.02), rng.uniform(3.0, 6.0)
    duration = region / 0.03
    times = np.concatenate([i * (duration + 4.0) + np.linspace(0, duration, len(along)) for i in range(len(lines))])
    clock = np.arange(0.0, times[-1] + 0.1, 0.05)
    wander = gaussian_filter1d(rng.standard_normal(len(clock)), 1.0 / np.sqrt(2) / 0.05)
    wander = wander / wander.std() + np.sqrt(2) * np.sin(2 * np.pi * clock / period + rng.uniform(0, 6))
    breathing = errors.breathing_m * np.interp(times, clock, wander) / np.sqrt(2)
    field = gaussian_filter(rng.standard_normal((75, 75)), 0.05 / np.sqrt(2) / PITCH_M)
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
    unsure = float(np.sqrt(errors.stroke_m**2 + errors.breathing_m**2 + errors.field_m**2))
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
