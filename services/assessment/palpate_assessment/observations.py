"""Samples as observations of one field: the logarithm of the force that a press to the common depth would feel."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from palpate_assessment.calibration import Calibration
from palpate_assessment.sampling import ForceSample
from palpate_models.numerics.frames import Array
from palpate_models.scenario import press

SHALLOWEST_M, WEAKEST_N = 0.002, 0.1
"""Least depth and force of a usable sample."""
USABLE_SHARE = 0.6
"""Least depth of a force-limited sample, as a share of the depth of the press: at 6 of 10 mm the exponent of the conversion
adds 6 % to its error. Chosen on `clean`, seeds 1000 to 1019; shallower limits are mostly bone."""
FEWEST = 10
"""Least number of samples."""


@dataclass(frozen=True)
class Observations:
    """y = z(x) + errors at m samples, z being the logarithm of apparent stiffness [N]."""

    xy: Array
    """Place of each sample [m], shape (m, 2), in A: ahead of the indenter's middle by `lead_s` of its travel."""
    time: Array
    """[s]"""
    stroke: NDArray[np.intp]
    y: Array
    """log F - n log(depth / press depth) - conversion, shape (m,)."""
    touched_for: Array
    """Time since the stroke touched [s]."""
    log_depth: Array
    """log(depth / press depth), by which an error of the exponent n counts."""
    per_metre: Array
    """|d y / d depth| = n / depth [1/m], by which an error of the depth counts."""
    per_newton: Array
    """1 / F [1/N], by which an error of the force's zero counts: F is the stroke's median force, since a sample's own force
    must not explain itself."""
    noise: Array
    """Standard deviation of the force's white noise, over the force [1]."""
    depth_uncertainty: Array
    """SD of the depth, as reported [m], shape (m,)."""
    yielded: NDArray[np.bool_]
    """True if the force limit was met at a depth too small to estimate the force of a full press."""

    @cached_property
    def same_stroke(self) -> NDArray[np.bool_]:
        """True where two samples are of one stroke, shape (m, m)."""
        return np.asarray(self.stroke[:, None] == self.stroke)

    def part(self, chosen: NDArray[np.intp] | slice) -> Observations:
        """Return some of the samples."""
        return Observations(**{field.name: getattr(self, field.name)[chosen] for field in fields(self)})


def observe(samples: Sequence[ForceSample], calibration: Calibration) -> Observations | None:
    """Return the usable samples; None if they are too few."""
    good = [s for s in samples if s.depth >= SHALLOWEST_M and s.force >= WEAKEST_N]
    if len(good) < FEWEST:
        return None
    position, velocity = np.array([s.position for s in good]), np.array([s.velocity for s in good])
    depth, force = np.array([s.depth for s in good]), np.array([s.force for s in good])
    log_depth, stroke = np.log(depth / press.DEPTH_M), np.array([s.stroke for s in good])
    usual = {int(one): float(np.median(force[stroke == one])) for one in np.unique(stroke)}
    return Observations(
        xy=(position + calibration.lead_s * velocity)[:, :2],
        time=np.array([s.time for s in good]),
        stroke=stroke,
        y=np.log(force) - calibration.exponent * log_depth - calibration.conversion,
        touched_for=np.array([s.time_in_contact for s in good]),
        log_depth=log_depth,
        per_metre=calibration.exponent / depth,
        per_newton=np.array([1.0 / usual[int(one)] for one in stroke]),
        noise=np.array([s.force_noise for s in good]) / force,
        depth_uncertainty=np.array([s.depth_uncertainty for s in good]),
        yielded=np.array([s.force_limited for s in good]) & (depth < USABLE_SHARE * press.DEPTH_M),
    )
