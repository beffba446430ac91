"""Samples to map and findings: the whole of the assessment, arrays in, arrays out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, gaussian_filter
from scipy.spatial import cKDTree

from palpate_assessment.apparent import FeltRatios, Footprints, Surroundings, apparent_stiffness
from palpate_assessment.contact import ReferenceContact
from palpate_assessment.findings import CANDIDATE_RATIO, StiffArea, candidates, find
from palpate_assessment.grid import MapGrid
from palpate_assessment.inversion import Z90, Noise, Observations, estimate_noise, invert, observe, spread_under
from palpate_assessment.prior import HEALTHY, LESION, Field
from palpate_assessment.sampling import ForceSample
from palpate_models import press
from palpate_models.frames import Array

Mask = NDArray[np.bool_]

_QUIET = 0.15
"""What is left of the lesions' variation away from candidates [1]."""
_SHALLOWEST, _WEAKEST = 0.002, 0.1
"""Depth [m] and force [N] from which a sample tells stiffness."""


@dataclass(frozen=True)
class Assessment:
    """The stiffness map on a grid's nodes, and the findings."""

    grid: MapGrid
    force: Array
    """Normal force at the common depth, sliding at the examination's speed [N], shape (n,)."""
    apparent: Array
    """Apparent stiffness: median of the force of the standard press [N], shape (n,)."""
    lower: Array
    """Lower end of its 90 % band [N]."""
    upper: Array
    stiffness: Array
    """Median of k_w, from which they follow [N/m^3], shape (n,)."""
    scanned: Mask
    """Within reach of a sample, shape (n,)."""
    background: float
    """Robust level of the unremarkable wall's apparent stiffness [N]."""
    findings: list[StiffArea]
    noise: Noise
    """What the samples get wrong, as estimated from themselves."""
    samples: int


def assess(
    samples: Sequence[ForceSample],
    grid: MapGrid,
    contact: ReferenceContact,
    reach: float,
    noise: Noise | None = None,
    refine: bool = True,
) -> Assessment | None:
    """Map and findings of a scan; None while there are too few samples.

    `reach`: distance within which a sample speaks for a node [m]. `refine=False` is the cheap variant for a growing map.
    """
    good = [s for s in samples if s.depth >= _SHALLOWEST and s.force >= _WEAKEST]
    if len(good) < 10:
        return None
    nodes = grid.nodes
    apart, _ = cKDTree(np.array([s.position for s in good])[:, :2]).query(nodes[:, :2])
    scanned = np.asarray(apart <= reach)
    observations = observe(good, grid, contact, noise or Noise())
    healthy = Field(grid, HEALTHY)
    mean = float(np.log(contact.material.k_w_n_per_m3))
    posterior = invert(observations, healthy + Field(grid, LESION), mean, iterations=6 if refine else 3)
    found: list[StiffArea] = []
    if refine:
        background = surroundings(posterior.mean, observations, grid, healthy, mean, scanned)
    for round_ in range(2 if refine else 0):
        envelope = lesion_envelope(posterior.mean - background, grid, scanned)
        lesion = Field(grid, LESION, envelope)
        observations = replace(observations, spread=spread_under(observations.footprint, posterior.mean))
        if round_ == 0:
            observations = replace(observations, noise=estimate_noise(observations, posterior, healthy + lesion))
        posterior = invert(observations, healthy + lesion, mean, posterior.mean, iterations=4)
        background = mean + healthy.times((posterior.weights @ posterior.jacobian)[None])[0]
    pressed = Footprints(grid, contact, press.DEPTH_M)
    if refine:
        ratios = partial(FeltRatios(posterior, observations, healthy, grid, mean), footprints=pressed)
        found = find(posterior.mean - background, grid, scanned, posterior, observations, healthy, ratios)
    apparent = apparent_stiffness(posterior, grid, contact, pressed)
    rest = scanned & ~np.any([f.nodes for f in found], axis=0) if found else scanned
    felt = Footprints(grid, contact, contact.common_depth).felt(posterior.mean)
    kept = 1.0 - np.array([s.lost for s in good]) / contact.force(np.array([s.depth for s in good]))
    unit = float(contact.force(np.array(contact.common_depth))) * float(np.median(kept))
    return Assessment(
        grid=grid,
        force=felt * unit,
        apparent=apparent.force,
        lower=apparent.force * np.exp(-Z90 * apparent.sd),
        upper=apparent.force * np.exp(Z90 * apparent.sd),
        stiffness=np.exp(posterior.mean),
        scanned=scanned,
        background=float(np.median(apparent.force[rest])),
        findings=found,
        noise=observations.noise,
        samples=len(good),
    )


def surroundings(z: Array, observations: Observations, grid: MapGrid, healthy: Field, mean: float, scanned: Mask) -> Array:
    """Log-modulus of the wall as it would be without stiff areas [log N/m^3], shape (n,).

    The healthy field's posterior from those samples alone whose footprint is clear of what stands out, found in three rounds.
    """
    level = np.full(z.size, float(np.quantile(z[scanned], 0.4)))
    H = observations.footprint
    for _ in range(3):
        out = (z - level > np.log(CANDIDATE_RATIO)) & scanned
        wide = binary_dilation(out.reshape(grid.z.shape), iterations=max(1, round(0.005 / grid.pitch))).ravel()
        clear = H @ wide.astype(float) < 0.15
        if clear.sum() < 10:
            return level
        level = Surroundings(clear, observations, healthy, mean).mean
    return np.asarray(level)


def lesion_envelope(excess: Array, grid: MapGrid, scanned: Mask) -> Array:
    """Where lesions may vary the stiffness: 1 in and about candidates, little elsewhere, shape (n,)."""
    about = np.zeros(grid.z.shape, dtype=bool)
    for area in candidates(excess, grid, scanned):
        about |= area.reshape(grid.z.shape)
    if not about.any():
        return np.full(grid.z.size, _QUIET)
    about = binary_dilation(about, iterations=max(1, round(0.012 / grid.pitch)))
    soft = gaussian_filter(about.astype(float), 0.006 / grid.pitch)
    return np.asarray(_QUIET + (1.0 - _QUIET) * soft.ravel())
