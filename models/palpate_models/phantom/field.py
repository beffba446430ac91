"""Stiffness over the surface: natural variation, stiffer margins, lesions with a smooth edge."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from palpate_models.frames import Array
from palpate_models.guarding import Guarding
from palpate_models.patient import Background, Lesion
from palpate_models.phantom.buried import at_skin
from palpate_models.seeds import generator

_FEATURES = 512
"""Random Fourier features of the background field: its covariance is within 1/sqrt(512) = 4 % of the Gaussian one."""
_MARGIN_START = 0.35
"""Part of the half length from which the wall grows stiffer towards costal margin and pelvis [assumption]."""
_COSTAL_SLOPE = 0.45
"""Descent of the costal arch a metre off the midline, so flanks under the ribs are stiffer earlier [assumption]."""


def smoothstep(t: Array) -> Array:
    """The cubic that rises from 0 at t <= 0 to 1 at t >= 1 with zero slope at both ends."""
    t = np.clip(t, 0.0, 1.0)
    return np.asarray(t * t * (3 - 2 * t))


def gaussian_field(points: Array, correlation_m: float, seed: int) -> Array:
    """A zero-mean, unit-variance Gaussian random field at points (n, 3) [m], shape (n,).

    Covariance exp(-r^2 / (2 correlation_m^2)), by random Fourier features (Rahimi and Recht 2007): a function of
    position, so the field does not depend on the mesh.
    """
    rng = generator(seed, "phantom")
    frequencies = rng.standard_normal((3, _FEATURES)) / correlation_m
    phases = rng.uniform(0, 2 * np.pi, _FEATURES)
    return np.asarray(np.cos(points @ frequencies + phases).sum(axis=1) * np.sqrt(2 / _FEATURES))


def background_factor(points: Array, background: Background, half_length: float, seed: int) -> Array:
    """Healthy stiffness over its nominal value at points (n, 3) of A [m], shape (n,).

    Log-normal with mean 1 and the given coefficient of variation, times a rise towards costal margin and pelvis.
    """
    sigma = np.sqrt(np.log1p(background.cv**2))
    variation = np.exp(sigma * gaussian_field(points, background.correlation_m, seed) - sigma**2 / 2)
    x, y = points[:, 0], points[:, 1]
    along = np.where(y > 0, y + _COSTAL_SLOPE * np.abs(x), -y) / half_length
    margin = 1 + (background.margins - 1) * smoothstep((along - _MARGIN_START) / (1 - _MARGIN_START))
    return np.asarray(variation * margin)


def edge_distance(xy: Array, area: Lesion | Guarding) -> Array:
    """Distance [m] of points (n, 2) from an area's elliptic outline, to first order; negative inside; (n,)."""
    offset = xy - np.asarray(area.centre_m)
    radii = np.asarray(area.radii_m)
    rho = np.sqrt(((offset / radii) ** 2).sum(axis=1))
    slope = np.sqrt(((offset / radii**2) ** 2).sum(axis=1))
    return np.asarray(np.where(rho > 1e-6, (rho - 1) * rho / np.maximum(slope, 1e-9), -radii.min()))


def lesion_field(xy: Array, lesions: Sequence[Lesion], front: NDArray[np.bool_] | None = None) -> tuple[Array, NDArray[np.int32]]:
    """Stiffness with lesions over stiffness without, and the lesion that a point belongs to (-1: none), both (n,).

    The contrast rises over `edge_m`, centred on the outline, so the outline is where it is half. Where lesions overlap, the one
    that changes more counts. A lesion below the skin counts as the skin shows it (`palpate_models.phantom.buried`). Only points
    where `front` is true can belong to a lesion.
    """
    factor = np.ones(len(xy))
    label = np.full(len(xy), -1, dtype=np.int32)
    for index, lesion in enumerate(map(at_skin, lesions)):
        distance = edge_distance(xy, lesion)
        share = smoothstep(0.5 - distance / lesion.edge_m)
        if front is not None:
            share = np.where(front, share, 0.0)
        own = 1 + (lesion.contrast - 1) * share
        stronger = np.abs(np.log(own)) > np.abs(np.log(factor))
        label[(share >= 0.5) & (stronger | (label < 0))] = index
        factor[stronger] = own[stronger]
    return factor, label
