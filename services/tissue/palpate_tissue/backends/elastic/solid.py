"""Finite elements of an elastic solid on a rigid base: the compliance of its skin.

The elements are trilinear bricks on a graded grid, condensed to normal forces and displacements of the skin. The volumetric
strain is averaged over the element (B-bar; Hughes 1980), because trilinear bricks of nearly incompressible tissue lock otherwise.
Base and sides are fixed.
"""

from collections.abc import Callable
from itertools import product
from typing import NamedTuple

import numpy as np
from scipy.linalg import cholesky, solve_triangular

from palpate_models.numerics.frames import Array


class NodeGrid(NamedTuple):
    """Nodes of the layer: x and y in the plane of the skin, depth below it (0 first, the base last), all ascending [m]."""

    x: Array
    y: Array
    depth: Array
    loaded_x: slice
    """Nodes of the skin that may be loaded, along x."""
    loaded_y: slice

    @property
    def skin(self) -> tuple[Array, Array]:
        """Return x and y of the loaded skin nodes [m]; the compliance is ordered with y fastest."""
        return self.x[self.loaded_x], self.y[self.loaded_y]


def graded_grid(low: Array, high: Array, thickness: float, pitch: float) -> NodeGrid:
    """Return a grid uniform with `pitch` [m] between the corners `low` and `high` (2,) [m], coarser outside and below."""
    half = (high - low) / 2
    x, along_x = _axis(float(half[0]), pitch)
    y, along_y = _axis(float(half[1]), pitch)
    centre = (low + high) / 2
    return NodeGrid(centre[0] + x, centre[1] + y, _layers(thickness, pitch), along_x, along_y)


def _axis(half: float, pitch: float) -> tuple[Array, slice]:
    count = int(np.ceil(half / pitch - 1e-9))
    inside = pitch * np.arange(-count, count + 1)
    others = inside[-1] + np.cumsum(pitch * 1.6 ** np.arange(1, 6))
    return np.concatenate((-others[::-1], inside, others)), slice(len(others), len(others) + len(inside))


def _layers(thickness: float, pitch: float) -> Array:
    """Return the depths of the nodes: cubes at the skin, each layer 14 % thicker than the previous."""
    sizes = pitch * 1.14 ** np.arange(200)
    below = np.cumsum(sizes)
    count = int(np.searchsorted(below, thickness)) + 1
    return np.concatenate(([0.0], below[:count] * (thickness / below[count - 1])))


def brick_stiffness(size: Array, poisson: float) -> Array:
    """Return the stiffness of bricks of unit Young's modulus and edges `size` [m], shape (e, 3): shape (e, 24, 24) [m].

    Nodes in the order of `product((0, 1), repeat=3)` over (x, y, depth), three displacements each.
    """
    corners = np.array(list(product((-1.0, 1.0), repeat=3)))
    shear = 1 / (2 * (1 + poisson))
    bulk = 1 / (3 * (1 - 2 * poisson))
    deviatoric = shear * (np.diag((2.0, 2, 2, 1, 1, 1)) - np.pad(np.full((3, 3), 2 / 3), (0, 3)))
    volume = size.prod(axis=1)
    total = np.zeros((len(size), 24, 24))
    mean = np.zeros((len(size), 24))
    for point in corners / np.sqrt(3.0):
        one = 1 + corners * point  # (8, 3)
        slope = np.stack([corners[:, k] * one[:, (k + 1) % 3] * one[:, (k + 2) % 3] for k in range(3)], axis=1) / 8
        slope = slope[None] * (2 / size)[:, None, :]  # d N / d x, (e, 8, 3)
        by_node = np.zeros((len(size), 6, 8, 3))
        for k in range(3):
            i, j = (k + 1) % 3, (k + 2) % 3
            by_node[:, k, :, k] = slope[:, :, k]
            by_node[:, 3 + k, :, i], by_node[:, 3 + k, :, j] = slope[:, :, j], slope[:, :, i]
        strain = by_node.reshape(len(size), 6, 24)
        total += (volume / 8)[:, None, None] * (strain.transpose(0, 2, 1) @ (deviatoric @ strain))
        mean += slope.reshape(len(size), 24) / 8
    return np.asarray(total + bulk * volume[:, None, None] * mean[:, :, None] * mean[:, None, :])


def skin_compliance(grid: NodeGrid, young: Callable[[Array], Array], poisson: float) -> Array:
    """Return the normal displacement of the loaded skin nodes per normal force on them [m/N], shape (k, k), symmetric.

    `young` gives Young's modulus [Pa], shape (p,), at points (x, y, depth) [m], shape (p, 3). The stiffness matrix is block
    tridiagonal over planes of constant x. With its block Cholesky factor L, the compliance is (L^-1 B)' (L^-1 B).
    """
    nx, ny, nd = len(grid.x), len(grid.y) - 2, len(grid.depth) - 1  # free nodes of a plane: y without sides, depth without base
    size = 3 * ny * nd
    slabs = (_slab(grid, young, poisson, column) for column in range(nx - 1))
    y_inside = np.arange(len(grid.y))[grid.loaded_y] - 1
    normal = 3 * (y_inside * nd) + 2  # unknowns of the skin's normal displacement in a plane; depth 0 is first
    loaded = set(range(nx)[grid.loaded_x])
    width = len(normal)
    result = np.zeros((len(loaded) * width, len(loaded) * width))
    carried = np.zeros((size, 0))  # L^-1 B of this plane, for the loads on planes before it
    _, after, _ = next(slabs)  # plane 0 is fixed
    for plane in range(1, nx - 1):
        before, next_after, coupling = next(slabs)
        factor = cholesky(after + before, lower=True, overwrite_a=True, check_finite=False)
        right = -carried
        if plane in loaded:
            load = np.zeros((size, width))
            load[normal, np.arange(width)] = 1
            right = np.hstack((right, load))
        solved = solve_triangular(factor, right, lower=True, overwrite_b=True, check_finite=False)
        k = solved.shape[1]
        result[:k, :k] += solved.T @ solved
        below = solve_triangular(factor, coupling, lower=True, overwrite_b=True, check_finite=False)
        after = next_after - below.T @ below
        carried = below.T @ solved
    return result


def _slab(grid: NodeGrid, young: Callable[[Array], Array], poisson: float, column: int) -> tuple[Array, Array, Array]:
    """Return the stiffness of the bricks between planes `column` and `column + 1`: of the first plane, the second, the coupling.

    Dense matrices on the free unknowns of a plane, ordered by y, depth, axis.
    """
    dy, dd = np.diff(grid.y), np.diff(grid.depth)
    wide = grid.x[column + 1] - grid.x[column]
    j, d = (index.ravel() for index in np.meshgrid(np.arange(len(dy)), np.arange(len(dd)), indexing="ij"))
    size = np.column_stack((np.full(len(j), wide), dy[j], dd[d]))
    origin = np.column_stack((np.full(len(j), grid.x[column]), grid.y[j], grid.depth[d]))
    places = (np.array(list(product((-1, 0, 1), repeat=3))) * np.sqrt(0.6) + 1) / 2  # Gauss-Legendre
    weights = np.array([np.prod([(5, 8, 5)[k] / 18 for k in at]) for at in product(range(3), repeat=3)])
    points = origin[:, None, :] + places[None] * size[:, None, :]
    modulus = young(points.reshape(-1, 3)).reshape(len(j), -1) @ weights
    stiffness = modulus[:, None, None] * brick_stiffness(size, poisson)
    nd, ny = len(dd), len(dy) - 1
    corner = np.array(list(product((0, 1), repeat=2)))
    at_y, at_d = j[:, None] + corner[:, 0] - 1, d[:, None] + corner[:, 1]
    free = (at_y >= 0) & (at_y < ny) & (at_d < nd)
    node = np.where(free, at_y * nd + at_d, 0)
    unknown = (3 * node[:, :, None] + np.arange(3)).reshape(len(j), 12)
    keep = np.repeat(free, 3, axis=1)
    pair = keep[:, :, None] & keep[:, None, :]
    n = 3 * ny * nd
    rows = np.broadcast_to(unknown[:, :, None], pair.shape)[pair]
    flat = rows * n + np.broadcast_to(unknown[:, None, :], pair.shape)[pair]

    def gather(block: Array) -> Array:
        return np.asarray(np.bincount(flat, block[pair], minlength=n * n), dtype=np.float64).reshape(n, n)

    return gather(stiffness[:, :12, :12]), gather(stiffness[:, 12:, 12:]), gather(stiffness[:, :12, 12:])
