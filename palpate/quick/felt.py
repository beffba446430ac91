"""Force of the standard press on a person, without physics in time.

The force at a place follows from stiffness and stiffening of the wall there (`force_at_10_mm`) and is averaged over the footprint
of the indenter on a Winkler-Pasternak foundation. It takes half a second per person.
"""

from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np
from scipy.interpolate import LinearNDInterpolator
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.signal import fftconvolve
from scipy.spatial import Delaunay
from scipy.special import k0, k1

from palpate_models.numerics.frames import Array
from palpate_models.patient.healthy import pressed_force
from palpate_models.patient.person import draw_person
from palpate_models.patient.phantom import PhantomModel, build_phantom
from palpate_models.patient.schema import Phantom, Stiffness
from palpate_models.scenario.press import DEPTH_M

PITCH_M: Final = 0.004
"""Spacing of the grid."""
HALF_M: Final = 0.148
"""Half the side of the square that is computed, about the origin of A."""
_RADIUS_M: Final = 0.015
"""Radius of the indenter."""
CONTACT_M: Final = 0.009
"""Radius of its contact at the depth of the standard press, from the obstacle problem of the foundation (computed)."""
POWER: Final = 0.8
"""Exponent of the power mean over the footprint: the wall yields next to a stiff place (computed)."""
_TENSION_GAIN: Final = 0.4
"""Increase of the force by muscle tension, relative to tension over k_w."""
_TABLE: Final = np.linspace(0.0, 600.0, 25)
"""Stiffening [1/m] at which the force is computed; linear between."""


class FeltPatient(NamedTuple):
    """Force of the standard press on a square grid about the umbilicus, the origin of A, with n x n places."""

    force: Array
    """[N], shape (n, n): row by y, column by x, both ascending."""
    healthy: Array
    """The force without lumps [N], shape (n, n)."""
    height: Array
    """Height z of the skin at rest [m], shape (n, n)."""
    breathing: Array
    """Share of the breathing excursion, shape (n, n)."""

    def force_at(self, xy: Array) -> Array:
        """Return the force [N] at places in A's xy plane [m], shape (m, 2) -> (m,)."""
        return between(self.force, xy)

    def excess_at(self, xy: Array) -> Array:
        """Return the log of the force with lumps over that without, at places in A's xy plane [m], shape (m, 2) -> (m,)."""
        return between(np.log(self.force / self.healthy), xy)

    def skin_at(self, xy: Array) -> Array:
        """Return the point of the skin at rest at a place [m], shape (2,) -> (3,), in A."""
        return np.append(xy, between(self.height, xy[None]))


def between(grid: Array, xy: Array) -> Array:
    """Return the values of a grid of `FeltPatient` at places in A's xy plane [m], shape (m, 2) -> (m,)."""
    return np.asarray(map_coordinates(grid, ((xy + HALF_M) / PITCH_M).T[::-1], order=1))


def felt_patient(phantom: Phantom, seed: int) -> FeltPatient:
    """Return the person of a seed with the lumps of the phantom. Raises MeshError as `build_phantom` does."""
    phantom = draw_person(phantom, seed)
    model = build_phantom(phantom, seed)
    axis = np.arange(-HALF_M, HALF_M + 1e-9, PITCH_M)
    footprint = _footprint(phantom.stiffness.length_m)
    front = (model.normals[:, 2] > 0.2) & (np.abs(model.vertices[:, :2]) < 1.2 * HALF_M).all(axis=1)
    xy = np.stack(np.meshgrid(axis, axis), axis=-1)
    mesh = Delaunay(model.vertices[front, :2])

    def raster(values: Array, beyond: float = 0.0) -> Array:
        return np.nan_to_num(LinearNDInterpolator(mesh, values[front])(xy), nan=beyond)

    def felt(modulus: Array) -> Array:
        force = force_at_10_mm(replace(model, stiffness=modulus), phantom.stiffness) * (1 + _TENSION_GAIN * model.tension)
        log_force = raster(np.log(force), float(np.log(np.median(force[front]))))
        padded = np.pad(np.exp(POWER * log_force), len(footprint) // 2, mode="edge")
        return np.asarray(fftconvolve(padded, footprint, mode="valid") ** (1 / POWER))

    forces = felt(model.stiffness), felt(model.background)
    return FeltPatient(*forces, raster(model.vertices[:, 2]), raster(model.breathing))


def _footprint(length: float) -> Array:
    """Return the sensitivity of the force to the modulus about the indenter, on the grid, square; its sum is 1.

    `length`: decay length l of the foundation [m].

    By the envelope theorem dF = dk_w (u phi + l^2 grad u . grad phi) with the influence phi = K0(r / l) / K0(a / l)
    beyond the contact.
    """
    reach = min(round(3 * length / PITCH_M) + 3, 15)
    axis = np.arange(-reach, reach + 1) * PITCH_M
    r = np.hypot(*np.meshgrid(axis, axis))
    a = CONTACT_M
    beyond = np.maximum(r, a) / length
    edge = DEPTH_M - _RADIUS_M + np.sqrt(_RADIUS_M**2 - a**2)
    outside = edge * (k0(beyond) ** 2 + k1(beyond) ** 2) / k0(a / length) ** 2
    inside = DEPTH_M - _RADIUS_M + np.sqrt(_RADIUS_M**2 - np.minimum(r, a) ** 2)
    footprint = gaussian_filter(np.where(r < a, inside, outside), 0.5)
    return np.asarray(footprint / footprint.sum())


def force_at_10_mm(model: PhantomModel, wall: Stiffness) -> Array:
    """Return the force [N] at 10 mm depth on a flat uniform wall with stiffness and stiffening of each vertex, shape (n,)."""
    unit = [pressed_force(wall.model_copy(update={"stiffening_per_m": beta}), 0.0) for beta in _TABLE.tolist()]
    return model.stiffness / wall.k_w_n_per_m3 * np.interp(model.stiffening, _TABLE, unit)
