"""Young's modulus inside the body: what the skin's stiffness says, continued inward, and lesions at their depth."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.interpolate import LinearNDInterpolator, NearestNDInterpolator

from palpate_models.numerics.frames import Array
from palpate_models.patient.field import lesion_field, smoothstep
from palpate_models.patient.phantom import PhantomModel
from palpate_models.patient.schema import Lesion
from palpate_tissue.friction import REFERENCE_E, REFERENCE_K_W

YOUNG_OVER_K_W = REFERENCE_E / REFERENCE_K_W
"""Young's modulus over foundation modulus of a wall that is equally stiff at 10 mm depth [m]."""


class ModulusField:
    """Instantaneous Young's modulus [Pa] at (x, y) of A and depth below the skin.

    The healthy modulus does not change with depth. A lesion with a depth is an ellipsoid whose upper side is there; one
    without is a column from the skin through the whole body, which is what the surface tier's lesions are.
    """

    def __init__(self, model: PhantomModel, lesions: Sequence[Lesion] = ()) -> None:
        front = model.normals[:, 2] > 0
        self._front = front
        self._skin = YOUNG_OVER_K_W * model.background
        log_young = np.log(self._skin[front])
        self._inside = LinearNDInterpolator(model.vertices[front, :2], log_young)
        self._outside = NearestNDInterpolator(model.vertices[front, :2], log_young)
        self._lesions = tuple(lesions)
        self._xy = model.vertices[:, :2]

    def healthy(self, xy: Array) -> Array:
        """Without lesions, at (p, 2) [m]; beyond the front, that of its nearest vertex; shape (p,)."""
        value = np.asarray(self._inside(xy))
        gap = np.isnan(value)
        if gap.any():
            value[gap] = self._outside(xy[gap])
        return np.asarray(np.exp(value))

    def __call__(self, points: Array) -> Array:
        """At points (x, y, depth) [m], shape (p, 3); shape (p,)."""
        # Points lie in columns, so the interpolation is done once a column.
        columns, of_point = np.unique(points[:, :2], axis=0, return_inverse=True)
        return np.asarray(self.healthy(columns)[of_point.ravel()] * lesion_factor(points, self._lesions))

    def at_skin(self) -> Array:
        """At the vertices of the skin, shape (n,)."""
        at = np.column_stack((self._xy, np.zeros(len(self._xy))))
        return np.asarray(self._skin * np.where(self._front, lesion_factor(at, self._lesions), 1.0))


def lesion_factor(points: Array, lesions: Sequence[Lesion]) -> Array:
    """Modulus with lesions over modulus without at points (x, y, depth) [m], shape (p, 3); shape (p,).

    As on the surface, the contrast rises over `edge_m` centred on the outline, and of overlapping lesions the stronger counts.
    """
    factor = np.ones(len(points))
    for lesion in lesions:
        if lesion.depth_m is None:
            own = lesion_field(points[:, :2], (lesion,))[0]
        else:
            own = 1 + (lesion.contrast - 1) * smoothstep(0.5 - _ellipsoid_distance(points, lesion) / lesion.edge_m)
        stronger = np.abs(np.log(own)) > np.abs(np.log(factor))
        factor[stronger] = own[stronger]
    return factor


def _ellipsoid_distance(points: Array, lesion: Lesion) -> Array:
    """Distance [m] from the ellipsoid, to first order, negative inside. Vertical half axis: the smaller of the other two."""
    assert lesion.depth_m is not None
    vertical = min(lesion.radii_m)
    radii = np.array((*lesion.radii_m, vertical))
    offset = (points - np.array((*lesion.centre_m, lesion.depth_m + vertical))) / radii
    rho = np.sqrt((offset**2).sum(axis=1))
    slope = np.sqrt(((offset / radii) ** 2).sum(axis=1))
    return np.asarray(np.where(rho > 1e-6, (rho - 1) * rho / np.maximum(slope, 1e-9), -radii.min()))
