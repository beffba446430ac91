"""A lump below the skin, as the skin shows it: what a tier that has no depth takes for it.

A surface tier has a stiffness for each place of the skin, and a buried ellipsoid gives to each a factor that is weaker and wider
the deeper it begins. The equivalent column has, for a lump of contrast c, vertical half axis R and depth d, S being the harmonic
mean of the half axes r seen from in front (R for a round lump),

    c' = 1 + P 0.857 (S / (S + d))^2 / (1 + (d / 14.6 mm)^2),   P = (c - 1) / (1 + 0.161 |c - 1| (d + 18.7 mm) / (R + d))
    r' = r sqrt(2 * 6 mm / R) + d / 2,                            edge' = edge + d, and no more than 2 r'

The forms are reasoned: the strain under an indenter falls with depth, and a small lump catches a part of it only; a stiff lump
is strained less than what is around it, as Eshelby's inclusion is, and the less the deeper it is embedded; of an ellipsoid the
skin shows the cap that is within 6 mm of its top. The constants of c' are fitted to axisymmetric finite elements of a press of 10
mm with a sphere of 15 mm: the felt ratio of forces is within 8.5 % for lumps of 10 to 20 mm with tops 0 to 20 mm deep
(`palpate validate --only buried`). Those of r' and edge' are fitted to the elastic tier, with lumps of 5 to 40 mm; there a lump
of 40 mm that touches the skin is felt 15 % too little. S was chosen on one ridge (docs/reality.md).
"""

import math
from collections.abc import Sequence
from statistics import harmonic_mean
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from palpate_models.numerics.frames import Array, Mask
from palpate_models.numerics.seeds import generator
from palpate_models.patient.schema import Background, Lesion, Structure
from palpate_models.patient.wall import Guarding


class FeltLump(NamedTuple):
    """Constants of the head of this file."""

    share: float = 0.857
    fade_m: float = 0.0146
    shield: float = 0.161
    shield_m: float = 0.0187
    cap_m: float = 0.006
    spread: float = 0.5


FELT: Final = FeltLump()


def at_skin(lesion: Lesion) -> Lesion:
    """Return the column through the wall that is felt as this lesion; one that reaches from the skin inward is its own."""
    if lesion.depth_m is None:
        return lesion
    depth, half, size = lesion.depth_m, min(lesion.radii_m), harmonic_mean(lesion.radii_m)
    more = lesion.contrast - 1
    polarised = more / (1 + FELT.shield * abs(more) * (depth + FELT.shield_m) / (half + depth))
    caught = FELT.share * (size / (size + depth)) ** 2 / (1 + (depth / FELT.fade_m) ** 2)
    cap = math.sqrt(2 * FELT.cap_m / half)
    a, b = (radius * cap + FELT.spread * depth for radius in lesion.radii_m)
    return lesion.model_copy(
        update={
            "contrast": 1 + polarised * caught,
            "radii_m": (a, b),
            "edge_m": min(lesion.edge_m + depth, 2 * min(a, b)),
            "depth_m": None,
        }
    )


class HealthyField(NamedTuple):
    """The healthy wall's variation."""

    features: int = 512
    """Random Fourier features of the background field: its covariance is within 1/sqrt(512) = 4 % of the Gaussian one."""
    margin_start: float = 0.35
    """Part of the half length from which the wall grows stiffer towards costal margin and pelvis [assumption]."""
    costal_slope: float = 0.45
    """Descent of the costal arch a metre off the midline, so flanks under the ribs are stiffer earlier [assumption]."""


HEALTHY: Final = HealthyField()


def smoothstep(t: Array) -> Array:
    """Return the cubic that rises from 0 at t <= 0 to 1 at t >= 1 with zero slope at both ends."""
    t = np.clip(t, 0.0, 1.0)
    return np.asarray(t * t * (3 - 2 * t))


def gaussian_field(points: Array, correlation_m: float, seed: int) -> Array:
    """Return a zero-mean, unit-variance Gaussian random field at points (n, 3) [m], shape (n,).

    Covariance exp(-r^2 / (2 correlation_m^2)), by random Fourier features (Rahimi and Recht 2007): a function of
    position, so the field does not depend on the mesh.
    """
    rng = generator(seed, "phantom")
    frequencies = rng.standard_normal((3, HEALTHY.features)) / correlation_m
    phases = rng.uniform(0, 2 * np.pi, HEALTHY.features)
    return np.asarray(np.cos(points @ frequencies + phases).sum(axis=1) * np.sqrt(2 / HEALTHY.features))


def background_factor(points: Array, background: Background, half_length: float, seed: int) -> Array:
    """Healthy stiffness over its nominal value at points (n, 3) of A [m], shape (n,).

    Log-normal with mean 1 and the given coefficient of variation, times a rise towards costal margin and pelvis.
    """
    sigma = np.sqrt(np.log1p(background.cv**2))
    variation = np.exp(sigma * gaussian_field(points, background.correlation_m, seed) - sigma**2 / 2)
    x, y = points[:, 0], points[:, 1]
    along = np.where(y > 0, y + HEALTHY.costal_slope * np.abs(x), -y) / half_length
    margin = 1 + (background.margins - 1) * smoothstep((along - HEALTHY.margin_start) / (1 - HEALTHY.margin_start))
    return np.asarray(variation * margin)


def _offset(xy: Array, line: Array) -> Array:
    """Return the vectors to points (n, 2) from the nearest point of a polyline (k, 2) [m], shape (n, 2)."""
    if len(line) == 1:
        return np.asarray(xy - line[0])
    begin, along = line[:-1], np.diff(line, axis=0)
    from_begin = xy[:, None] - begin
    share = np.clip((from_begin * along).sum(axis=2) / np.maximum((along**2).sum(axis=1), 1e-12), 0.0, 1.0)
    offsets = from_begin - share[..., None] * along
    nearest = (offsets**2).sum(axis=2).argmin(axis=1)
    return np.asarray(offsets[np.arange(len(xy)), nearest])


def edge_distance(xy: Array, area: Lesion | Guarding | Structure) -> Array:
    """Distance [m] of points (n, 2) from an area's outline, to first order; negative inside; (n,)."""
    offset = _offset(xy, np.array(area.line_m if isinstance(area, Structure) else [area.centre_m]))
    radii = np.asarray(area.radii_m)
    rho = np.sqrt(((offset / radii) ** 2).sum(axis=1))
    slope = np.sqrt(((offset / radii**2) ** 2).sum(axis=1))
    return np.asarray(np.where(rho > 1e-6, (rho - 1) * rho / np.maximum(slope, 1e-9), -radii.min()))


def lesion_field(xy: Array, lesions: Sequence[Lesion], front: Mask | None = None) -> tuple[Array, NDArray[np.int32]]:
    """Stiffness with lesions over stiffness without, and the lesion that a point belongs to (-1: none), both (n,).

    The contrast rises over `edge_m`, centred on the outline, so the outline is where it is half. Where lesions overlap, the one
    that changes more counts. A lesion below the skin counts as the skin shows it (`palpate_models.patient.field`). Only points
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


def structure_at_skin(structure: Structure) -> Structure:
    """Return the structure through the wall that is felt as this one, as `at_skin` of a lump of its length and width."""
    if structure.depth_m is None:
        return structure
    line, width = np.array(structure.line_m), min(structure.radii_m)
    longer = float(np.linalg.norm(np.diff(line, axis=0), axis=1).sum()) / 2
    lump = Lesion(
        centre_m=structure.line_m[0],
        radii_m=(longer + max(structure.radii_m), width),
        contrast=structure.factor,
        edge_m=structure.edge_m,
        depth_m=structure.depth_m,
    )
    felt = at_skin(lump)
    grown = felt.radii_m[1] / width
    radii = (structure.radii_m[0] * grown, structure.radii_m[1] * grown)
    return structure.model_copy(update={"radii_m": radii, "factor": felt.contrast, "edge_m": felt.edge_m, "depth_m": None})


def structure_share(xy: Array, structure: Structure) -> Array:
    """Return the share of its full effect that a structure through the wall has at points (n, 2), shape (n,)."""
    return smoothstep(0.5 - edge_distance(xy, structure) / structure.edge_m)
