"""A body from a grid file: surface and mechanics over x and y of A, as measured on a real body (`palpate fit` writes one).

The file is CSV with a header and one row per node of a complete regular grid, in any order. `columns` names quantities and units.
"""

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from scipy.interpolate import RegularGridInterpolator
from scipy.spatial import Delaunay

from palpate_errors import restate
from palpate_models.numerics.frames import Array
from palpate_models.patient.abdomen import Shape, lattice, rings
from palpate_models.patient.mesh import boundary_vertices, orient, vertex_normals
from palpate_models.patient.mesh_file import MeshError


class GridTuning(NamedTuple):
    """A grid that can be a body."""

    apron_m: float = 0.12
    """Continuation of a body around its grid: the camera follows the wall next to the arm."""
    min_nodes: int = 4
    """Minimum number of nodes along an axis."""
    pitch_tolerance: float = 0.01
    """Largest deviation of a node from its place, over the pitch."""


GRID: Final = GridTuning()


class GridError(MeshError):
    """A grid file that cannot be a body. The message names the file, the column, the value and what is allowed."""


@dataclass(frozen=True)
class BodyGrid:
    """Quantities at n nodes of a regular grid, x slowest, each of shape (n,)."""

    x_m: Array
    y_m: Array
    z_m: Array
    """Height of the surface at rest."""
    k_w_n_per_m3: Array
    """Instantaneous foundation modulus without lesions."""
    young_pa: Array
    """Young's modulus of the elastic tier without lesions."""
    stiffening_per_m: Array

    def at(self, name: str, xy: Array) -> Array:
        """Return a column at points (p, 2) [m], shape (p,): bilinear; beyond the grid that of its nearest point."""
        axes = np.unique(self.x_m), np.unique(self.y_m)
        values = getattr(self, name).reshape(len(axes[0]), len(axes[1]))
        inside = np.clip(xy, [axis[0] for axis in axes], [axis[-1] for axis in axes])
        return np.asarray(RegularGridInterpolator(axes, values)(inside))

    def surface(self, edge_m: float) -> Shape:
        """Return the surface with edges of about `edge_m` [m]; it continues by `GRID.apron_m` to a fixed border."""
        low, high = (np.array((f(self.x_m), f(self.y_m))) for f in (np.min, np.max))
        half = (high - low) / 2
        inner = lattice(half[0], half[1], edge_m)
        apron = rings(half[0], half[1], (half[0] + GRID.apron_m, half[1] + GRID.apron_m), edge_m)
        xy = (low + high) / 2 + np.concatenate((inner, apron))
        vertices = np.column_stack((xy, self.at("z_m", xy)))
        triangles = Delaunay(np.round(xy, 7)).simplices.astype(np.int32)
        corners = xy[triangles]
        area = np.abs(np.linalg.det(corners[:, 1:] - corners[:, :1]))
        triangles = orient(vertices, triangles[area > 1e-2 * edge_m**2])  # without slivers along the border
        normals = vertex_normals(vertices, triangles)
        return Shape(vertices, triangles, normals, boundary_vertices(len(vertices), triangles))

    def write(self, path: Path) -> None:
        """Write the file."""
        rows = np.column_stack([getattr(self, name) for name in columns])
        np.savetxt(path, rows, fmt="%.6g", delimiter=",", header=",".join(columns), comments="")


columns = tuple(field.name for field in fields(BodyGrid))
_LIMITS = {
    "x_m": (-1.0, 1.0),
    "y_m": (-1.0, 1.0),
    "z_m": (-1.0, 1.0),
    "k_w_n_per_m3": (1e3, 1e9),
    "young_pa": (1e2, 1e8),
    "stiffening_per_m": (0.0, 5e3),
}


def read_grid(path: Path) -> BodyGrid:
    """Return the grid of a file. Raises GridError."""
    with restate((OSError, ValueError), GridError, f"phantom.grid = {path}: cannot be read as CSV"):
        table = np.genfromtxt(path, delimiter=",", names=True, encoding="utf-8", ndmin=1)
    if sorted(table.dtype.names or ()) != sorted(columns):
        raise GridError(f"phantom.grid = {path}: has columns {', '.join(table.dtype.names or ())}; expected {', '.join(columns)}")
    for name, (low, high) in _LIMITS.items():
        bad = ~((table[name] >= low) & (table[name] <= high))
        if bad.any():
            row = int(bad.argmax())
            raise GridError(f"phantom.grid = {path}, row {row + 1}: {name} = {table[name][row]}, expected {low:g} to {high:g}")
    axes = [np.unique(table[name]) for name in ("x_m", "y_m")]
    for name, axis in zip(("x_m", "y_m"), axes, strict=True):
        steps = np.diff(axis)
        if len(axis) < GRID.min_nodes or np.ptp(steps) > GRID.pitch_tolerance * steps.mean():
            raise GridError(
                f"phantom.grid = {path}: {name} has {len(axis)} values; expected {GRID.min_nodes} or more at equal distances"
            )
    table = table[np.lexsort((table["y_m"], table["x_m"]))]
    if len(np.unique(table[["x_m", "y_m"]])) != len(table) or len(table) != len(axes[0]) * len(axes[1]):
        raise GridError(f"phantom.grid = {path}: {len(table)} rows; expected {len(axes[0])} x {len(axes[1])}, one a node")
    return BodyGrid(**{name: table[name].copy() for name in columns})
