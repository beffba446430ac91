"""The phantom as arrays: rest surface, discrete Laplacian, stiffness with and without lesions.

Its surface and mechanics over x and y of A may come from a grid file, as measured on a real body (`palpate fit` writes one): CSV
with a header and one row per node of a complete regular grid, in any order. `columns` names quantities and units.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
import robust_laplacian
from scipy import sparse
from scipy.interpolate import RegularGridInterpolator
from scipy.spatial import Delaunay

from palpate_errors import restate
from palpate_models.numerics.frames import Array, Ints32, Mask
from palpate_models.patient.abdomen import Shape, lattice, parametric_surface, rings
from palpate_models.patient.field import background_factor, lesion_field, structure_at_skin, structure_share
from palpate_models.patient.healthy import healthy_wall, tension_field
from palpate_models.patient.mesh import MeshError, boundary_vertices, load_mesh, orient, vertex_normals
from palpate_models.patient.person import draw_person
from palpate_models.patient.schema import Lesion, Phantom


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


_POSTERIOR_M = 0.010
"""Vertices of a user's mesh this close to its lowest point lie on the table and do not move."""


@dataclass(frozen=True)
class PhantomModel:
    """A phantom at rest, in the abdomen frame A: origin at the umbilicus, x to the patient's left, y to the head, z outward."""

    vertices: Array
    """Vertex positions at rest [m], shape (n, 3), in A."""
    triangles: Ints32
    """Vertex indices, shape (m, 3), counter-clockwise seen from outside."""
    normals: Array
    """Outward unit vertex normals, shape (n, 3), in A."""
    areas: Array
    """Area that belongs to each vertex [m^2], shape (n,)."""
    laplacian: sparse.csr_array
    """Cotangent Laplacian [1] of the intrinsic Delaunay triangulation, shape (n, n), integrated: L u = -A nabla^2 u.

    Positive semidefinite: off-diagonal elements are <= 0.
    """
    stiffness: Array
    """Instantaneous foundation modulus k_w [N/m^3], shape (n,), with lesions."""
    background: Array
    """Modulus k_w without lesions but with structures [N/m^3], shape (n,)."""
    stiffening: Array
    """Stiffening with depth [1/m], shape (n,): see `Stiffness.stiffening_per_m`."""
    tension: Array
    """Additional modulus of contracted muscle relative to k_w [1], shape (n,); 0 without guarding."""
    lesion: Ints32
    """Index of the lesion in whose half-contrast outline the vertex lies, -1 elsewhere, shape (n,)."""
    fixed: Mask
    """Vertices that do not move: the border of the examined body, and its back on the table; shape (n,)."""
    breathing: Array
    """Part of the breathing excursion at each vertex, 1 about the umbilicus, 0 where fixed; shape (n,)."""
    young: Array | None = None
    """Instantaneous Young's modulus without lesions [Pa], shape (n,); None if it is proportional to `background`."""
    voluntary: bool = False
    """The tension fades under gentle pressure: see `palpate_models.patient.wall.Activation`."""


def build_phantom(phantom: Phantom, seed: int) -> PhantomModel:
    """Return the phantom of a scenario; a person is drawn first. Equal seeds give equal walls at any mesh resolution.

    Raises MeshError or GridError if a user's file or a lesion cannot be used.
    """
    phantom = draw_person(phantom, seed)
    grid = None if phantom.grid is None else read_grid(Path(phantom.grid))
    if phantom.mesh is not None:
        surface = load_mesh(Path(phantom.mesh), phantom.edge_m)
        vertices, triangles = surface.vertices, surface.triangles
        normals = vertex_normals(vertices, triangles)
        fixed = boundary_vertices(len(vertices), triangles)
        if not fixed.any():  # closed: its back lies on the table
            fixed |= vertices[:, 2] < vertices[:, 2].min() + _POSTERIOR_M
        if fixed.all():
            raise MeshError(f"phantom.mesh = {phantom.mesh}: all of its vertices are on its border or its back, none can move")
    else:
        if grid is not None:
            shape = grid.surface(phantom.edge_m)
        else:
            shape = parametric_surface(phantom.size_m, phantom.edge_m, phantom.anatomy)
        vertices, triangles, normals, fixed = shape.vertices, shape.triangles, shape.normals, shape.fixed
    laplacian, mass = robust_laplacian.mesh_laplacian(vertices, triangles)
    laplacian = sparse.csr_array(laplacian)
    laplacian.sort_indices()
    half_length = float(np.ptp(vertices[:, 1])) / 2
    young = None
    if grid is not None:
        background, young, stiffening = (
            grid.at(name, vertices[:, :2]) for name in ("k_w_n_per_m3", "young_pa", "stiffening_per_m")
        )
    else:
        background = phantom.stiffness.k_w_n_per_m3 * background_factor(vertices, phantom.background, half_length, seed)
        stiffening = np.full(len(vertices), phantom.stiffness.stiffening_per_m)
    if phantom.anatomy is not None:
        wall = healthy_wall(vertices, phantom.size_m, phantom.anatomy, phantom.stiffness.stiffening_per_m, seed)
        background, stiffening = background * wall.stiffness, wall.stiffening
    for index, structure in enumerate(map(structure_at_skin, phantom.structures)):
        share = np.where(normals[:, 2] > 0, structure_share(vertices[:, :2], structure), 0.0)
        if not share.any():
            raise MeshError(f"phantom.structures[{index}]: line_m {structure.line_m}: no point of the abdomen's front is in it")
        factor = 1 + (structure.factor - 1) * share
        background, young = background * factor, None if young is None else young * factor
    contrast, lesion = lesion_field(vertices[:, :2], phantom.lesions, front=normals[:, 2] > 0)
    for index in sorted(set(range(len(phantom.lesions))) - set(lesion.tolist())):
        centre, radii = phantom.lesions[index].centre_m, phantom.lesions[index].radii_m
        raise MeshError(
            f"phantom.lesions[{index}]: centre_m {centre}, radii_m {radii}: no point of the abdomen's front belongs to it "
            "(expected metres from the umbilicus; a stiffer lesion may cover it; if drawn, a smaller phantom.draw.region_m)"
        )
    tension = tension_field(vertices[:, :2], phantom.guarding, phantom.stiffness, front=normals[:, 2] > 0)
    return PhantomModel(
        vertices=vertices,
        triangles=triangles,
        normals=normals,
        areas=np.asarray(mass.diagonal(), dtype=np.float64),
        laplacian=laplacian,
        stiffness=background * contrast,
        background=background,
        stiffening=stiffening,
        tension=tension,
        lesion=lesion,
        fixed=fixed,
        breathing=_breathing_profile(vertices, normals, fixed),
        young=young,
        voluntary=any(area.kind == "voluntary" for area in phantom.guarding),
    )


def _breathing_profile(vertices: Array, normals: Array, fixed: Mask) -> Array:
    """Share of the excursion, shape (n,): largest about the umbilicus, none at the ends, the flanks and the back."""
    y = vertices[:, 1]
    along = np.cos(np.where(y > 0, y / y.max(), y / y.min()) * np.pi / 2) ** 2
    profile = along * np.clip(normals[:, 2], 0, 1) ** 2
    return np.where(fixed, 0.0, profile)


def flat_phantom(
    half_m: float = 0.13, edge_m: float = 0.005, k_w_n_per_m3: float = 1.7e5, lesions: Sequence[Lesion] = ()
) -> PhantomModel:
    """Return a square of half width `half_m` [m] in z = 0 on a hexagonal lattice of `edge_m` [m]; its border is fixed.

    A vertex is at the origin. The breathing profile is 1 everywhere inside.
    """
    points = lattice(half_m, half_m, edge_m)
    triangles = Delaunay(points).simplices
    a, b, c = (points[triangles[:, k]] for k in range(3))
    double_area = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    flat = np.abs(double_area) < 1e-3 * edge_m**2  # Qhull's slivers along the border
    triangles = np.where((double_area > 0)[:, None], triangles, triangles[:, ::-1])[~flat].astype(np.int32)
    n = len(points)
    vertices = np.column_stack((points, np.zeros(n)))
    laplacian, mass = robust_laplacian.mesh_laplacian(vertices, triangles)
    contrast, lesion = lesion_field(points, lesions)
    fixed = boundary_vertices(n, triangles)
    return PhantomModel(
        vertices=vertices,
        triangles=triangles,
        normals=np.tile((0.0, 0.0, 1.0), (n, 1)),
        areas=np.asarray(mass.diagonal(), dtype=np.float64),
        laplacian=sparse.csr_array(laplacian),
        stiffness=k_w_n_per_m3 * contrast,
        background=np.full(n, k_w_n_per_m3),
        stiffening=np.zeros(n),
        tension=np.zeros(n),
        lesion=lesion,
        fixed=fixed,
        breathing=np.where(fixed, 0.0, 1.0),
    )
