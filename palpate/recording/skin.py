"""The unpressed skin: a smooth height field through the places where contacts begin, as a Gaussian process."""

from pathlib import Path
from typing import Final, NamedTuple
from warnings import catch_warnings

import numpy as np
from scipy.interpolate import LinearNDInterpolator, NearestNDInterpolator, RectBivariateSpline
from scipy.linalg import cho_solve
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel
from threadpoolctl import threadpool_limits

from palpate_errors import UserError, restate
from palpate_models.numerics.frames import Array, apply
from palpate_models.patient.mesh import vertex_normals
from palpate_models.patient.mesh_file import read_mesh

_MOST: Final = 300
"""Points that the process is fitted to."""
_NODES: Final = 40
"""Nodes of its grid along the longer side."""
_OUTLIERS: Final = 3
"""Times that points are given less weight, which are this many SD off the skin through the others:"""
_STRANGE: Final = 4.0
_NARROW: Final = 0.1
"""Minimum RMS width of the points, over the shortest length of the skin, over which it has a slope."""
_PLANE: Final = 4
"""Minimum number of points that a plane is fitted to."""


class RecordedSkin(NamedTuple):
    """Heights of the tool's centre at first contact over the xy plane of A, on a grid."""

    x: Array
    y: Array
    """[m]"""
    z: Array
    """[m], shape (nx, ny)."""
    sd: Array
    """[m], shape (nx, ny)."""

    def at(self, xy: Array) -> tuple[Array, Array, Array]:
        """Return height [m] (k,), outward unit normal (k, 3) and SD of the height [m] (k,) at places [m], shape (k, 2)."""
        surface = RectBivariateSpline(self.x, self.y, self.z, kx=3, ky=3)
        slope = np.column_stack((surface.ev(xy[:, 0], xy[:, 1], dx=1), surface.ev(xy[:, 0], xy[:, 1], dy=1)))
        normal = np.column_stack((-slope, np.ones(len(xy))))
        spread = RectBivariateSpline(self.x, self.y, self.sd, kx=1, ky=1).ev(*xy.T)
        return surface.ev(*xy.T), normal / np.linalg.norm(normal, axis=1)[:, None], spread

    def points(self) -> tuple[Array, Array]:
        """Return its nodes [m] and their normals, shape (n, 3) each."""
        xy = np.stack(np.meshgrid(self.x, self.y, indexing="ij"), axis=-1).reshape(-1, 2)
        z, normal, _ = self.at(xy)
        return np.column_stack((xy, z)), normal

    def through(self, points: Array, sd: Array) -> "RecordedSkin":
        """Return the skin moved outward or inward to points of standard deviation `sd` [m], by their weighted mean."""
        off = points[:, 2] - self.at(points[:, :2])[0]
        near = np.abs(off - np.median(off)) <= 5 * np.median(np.abs(off - np.median(off))) + 1e-9
        return self._replace(z=self.z + float(np.average(off[near], weights=sd[near] ** -2)))


def of_mesh(file: Path, scale: float, X_AW: Array, radius: float, stations: tuple[Array, Array]) -> RecordedSkin:
    """Return the skin of a mesh in the frame of the positions, in units of `scale` [m]. Raises UserError."""
    with restate(UserError, UserError, f"body.surface = {file}"):
        vertices, triangles = read_mesh(file)
    centres = apply(X_AW, scale * vertices)
    centres += radius * vertex_normals(centres, triangles)
    xy = np.stack(np.meshgrid(*stations, indexing="ij"), axis=-1)
    z = LinearNDInterpolator(centres[:, :2], centres[:, 2])(xy)
    z = np.where(np.isfinite(z), z, NearestNDInterpolator(centres[:, :2], centres[:, 2])(xy))
    return RecordedSkin(*stations, z, np.full(z.shape, 0.0))


def grid_over(xy: Array, margin: float) -> tuple[Array, Array]:
    """Return the stations in x and y of a grid over places [m], shape (n, 2), and a margin [m]."""
    low, high = xy.min(axis=0) - margin, xy.max(axis=0) + margin
    step = float((high - low).max()) / _NODES
    x, y = (np.linspace(a, b, max(5, round((b - a) / step) + 1)) for a, b in zip(low, high, strict=True))
    return x, y


def fit_skin(points: Array, sd: Array, stations: tuple[Array, Array], shortest: float) -> RecordedSkin:
    """Return the skin through points [m], shape (n, 3), of standard deviation `sd` [m], shape (n,).

    `shortest`: shortest length over which the skin varies [m].
    """
    chosen = np.argsort(sd, kind="stable")[:: max(1, len(sd) // _MOST)]
    points, sd = points[chosen], sd[chosen]
    centre = points.mean(axis=0)
    terms = 3 if len(points) >= _PLANE else 1
    sloping = _terms(points, centre, terms) / sd[:, None]
    # a line shows no slope across it
    plane = np.linalg.lstsq(sloping, (points[:, 2] - centre[2]) / sd, rcond=_NARROW * shortest)[0]
    rest = points[:, 2] - centre[2] - _terms(points, centre, terms) @ plane
    size = max(float(np.sqrt(np.mean(rest**2))), float(np.median(sd)), 1e-6)
    extent = float(np.ptp(points[:, :2], axis=0).max()) + shortest
    noise = (sd / size) ** 2
    smooth = ConstantKernel(1.0, (0.05, 1e3)) * RBF(max(shortest, 0.5 * extent), (shortest, 10 * extent))
    process = GaussianProcessRegressor(smooth + WhiteKernel(0.05, (1e-4, 1.0)), alpha=noise)
    with threadpool_limits(1), catch_warnings(action="ignore"):  # the best length may be at its bound
        process.fit(points[:, :2], rest / size)
        for _ in range(_OUTLIERS):
            precision = np.diag(cho_solve((process.L_, True), np.eye(len(points))))
            off = process.alpha_ / precision  # of each point from the skin through the others
            strange = np.abs(off) * np.sqrt(precision) > _STRANGE
            if not strange.any():
                break
            noise = np.where(strange, np.maximum(noise, off**2), noise)
            process = GaussianProcessRegressor(process.kernel_, alpha=noise, optimizer=None).fit(points[:, :2], rest / size)
    x, y = stations
    xy = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
    mean, spread = process.predict(xy, return_std=True)
    z = centre[2] + _terms(xy, centre, terms) @ plane + size * mean
    known = np.sqrt(np.maximum(spread**2 - process.kernel_.k2.noise_level, 0.0))  # of the skin, not of a point of it
    return RecordedSkin(x, y, z.reshape(len(x), len(y)), (size * known).reshape(len(x), len(y)))


def _terms(places: Array, centre: Array, count: int) -> Array:
    """Return the terms of a plane, or of a level, at places [m], shape (n, count)."""
    return np.column_stack((np.ones(len(places)), *(places[:, k] - centre[k] for k in (0, 1))))[:, :count]
