"""The compiled part of the tissue's step: loops over vertices, in the order that the FMU's C source has them.

Compiled once by numba (`palpate_models.compiled`).
"""

from __future__ import annotations

from math import sqrt

import numpy as np
from numpy.typing import NDArray

from palpate_models.compiled import compiled
from palpate_tissue.friction import rub

Array = NDArray[np.float64]
Index = NDArray[np.uint16] | NDArray[np.uint32]
"""Unsigned: a signed index may be negative to numba, and looking each time doubles the cost of the field's step."""
_USUAL = 7
"""Entries of most rows of the field's matrix: a vertex and its six neighbours."""


@compiled
def relax(indptr: Index, indices: Index, rate: Array, branches: Array, strain: Array, u: Array) -> None:
    """The field as it moves by itself over a step: u += A (u - sum_k y_k), A in CSR form, `branches` of shape (k, n)."""
    n = u.shape[0]
    for i in range(n):
        strain[i] = u[i]
    for k in range(branches.shape[0]):
        for i in range(n):
            strain[i] -= branches[k, i]
    begin = indptr[0]
    for i in range(n):
        total = u[i]
        end = indptr[i + 1]
        if end - begin == _USUAL:  # unrolled by the compiler: a quarter faster
            for j in range(_USUAL):
                total += rate[begin + j] * strain[indices[begin + j]]
        else:
            for j in range(begin, end):
                total += rate[j] * strain[indices[j]]
        u[i] = total
        begin = end


@compiled
def remember(branches: Array, decay: Array, feed: Array, u: Array) -> None:
    """The Prony branches, exact for a displacement held over the step: y_k = decay_k y_k + feed_k u."""
    for k in range(branches.shape[0]):
        fade, gain = decay[k], feed[k]
        for i in range(u.shape[0]):
            branches[k, i] = branches[k, i] * fade + gain * u[i]


@compiled
def hold(
    index: Index, vertices: Array, q: Array, radius: float, rim: float, excursion: float, u: Array, f: Array, out: Array
) -> float:
    """Holds the vertices under the sphere on its surface; returns the sum of their forces [N].

    `vertices` (m, 8) has a row for each vertex: its outward normal, its position [m] from the same origin as the sphere's
    centre `q` (3,), its share of the breathing `excursion` [m] and C / h [N/m]. Vertices whose surface makes an angle with a
    cosine below `rim` with the tangent plane are left alone. `f` (m,) gets each vertex's force along its inward normal [N];
    `out` (9,) the force on the sphere [N], the sum of f times outward normals [N], and the arm of the contact's centre
    from the sphere's [m].
    """
    load = fx = fy = fz = nx = ny = nz = rx = ry = rz = 0.0
    square_radius = radius * radius
    least = square_radius * rim * rim
    for k in range(index.shape[0]):
        f[k] = 0.0
        x, y, z = vertices[k, 0], vertices[k, 1], vertices[k, 2]
        dx, dy, dz = q[0] - vertices[k, 3], q[1] - vertices[k, 4], q[2] - vertices[k, 5]
        below = -(x * dx + y * dy + z * dz)
        square = square_radius - (dx * dx + dy * dy + dz * dz) + below * below  # R^2 - lateral distance^2
        if square <= least:
            continue
        half = sqrt(square)
        rest = below + half
        i = index[k]
        gap = rest + excursion * vertices[k, 6] - u[i]
        if gap <= 0.0:
            continue
        u[i] += gap
        force = gap * vertices[k, 7]
        f[k] = force
        steep = force / half
        load += force
        nx += force * x
        ny += force * y
        nz += force * z
        # Force on the sphere: f (n + lateral / half), lateral = q - X + below n.
        fx += force * x + steep * (dx + below * x)
        fy += force * y + steep * (dy + below * y)
        fz += force * z + steep * (dz + below * z)
        # The vertex is where the sphere holds it: X - rest n.
        rx -= force * (dx + rest * x)
        ry -= force * (dy + rest * y)
        rz -= force * (dz + rest * z)
    out[0], out[1], out[2] = fx, fy, fz
    out[3], out[4], out[5] = nx, ny, nz
    if load > 0.0:
        out[6], out[7], out[8] = rx / load, ry / load, rz / load
    return load


@compiled
def contact(
    index: Index,
    vertices: Array,
    origin: Array,
    sphere: Array,
    radius: float,
    rim: float,
    excursion: float,
    u: Array,
    f: Array,
    bristle: Array,
    friction: Array,
    wrench: Array,
) -> bool:
    """Holds the vertices under the sphere (see `hold`) and rubs it; `wrench` (6,) gets force [N] and torque [N m] on it.

    `sphere` (3, 3) has the position of its centre [m], its velocity [m/s] and its angular velocity [rad/s]; `origin` (3,) [m]
    is that of the vertices. `friction` (3,) is the coefficient, the skin's stiffness [N/m] and the step [s], `bristle` (3,)
    its stretch [m]. False where nothing is touched: `wrench` and `bristle` are then left alone.
    """
    q, sums = np.empty(3), np.empty(9)
    for axis in range(3):
        q[axis] = sphere[0, axis] - origin[axis]
    if hold(index, vertices, q, radius, rim, excursion, u, f, sums) <= 0.0:
        return False
    nx, ny, nz = sums[3], sums[4], sums[5]
    rx, ry, rz = sums[6], sums[7], sums[8]
    wx, wy, wz = sphere[2, 0], sphere[2, 1], sphere[2, 2]
    vx, vy, vz = sphere[1, 0] + wy * rz - wz * ry, sphere[1, 1] + wz * rx - wx * rz, sphere[1, 2] + wx * ry - wy * rx
    load = sqrt(nx * nx + ny * ny + nz * nz)
    nx, ny, nz = nx / load, ny / load, nz / load
    tx, ty, tz = rub(bristle, friction[0], friction[1], friction[2], vx, vy, vz, nx, ny, nz, load)
    wrench[0], wrench[1], wrench[2] = sums[0] + tx, sums[1] + ty, sums[2] + tz
    wrench[3], wrench[4], wrench[5] = ry * tz - rz * ty, rz * tx - rx * tz, rx * ty - ry * tx
    return True


@compiled
def step(
    indptr: Index,
    indices: Index,
    rate: Array,
    branches: Array,
    decay: Array,
    feed: Array,
    strain: Array,
    u: Array,
    disturbed: bool,
    index: Index,
    vertices: Array,
    origin: Array,
    sphere: Array,
    radius: float,
    rim: float,
    excursion: float,
    f: Array,
    bristle: Array,
    friction: Array,
    wrench: Array,
) -> bool:
    """One explicit step of field, contact and branches; see `relax`, `contact` and `remember`. Whether the sphere touches.

    A surface that is not `disturbed` is at rest exactly, and stays so until it is touched.
    """
    if disturbed:
        relax(indptr, indices, rate, branches, strain, u)
    touching = contact(index, vertices, origin, sphere, radius, rim, excursion, u, f, bristle, friction, wrench)
    if disturbed or touching:
        remember(branches, decay, feed, u)
    return touching


@compiled
def turn(vectors: Array, R: Array, out: Array) -> None:
    """Vectors (k, 3) in other axes: `out` (k, 3) gets R times each, for a rotation `R` (3, 3)."""
    for k in range(vectors.shape[0]):
        x, y, z = vectors[k, 0], vectors[k, 1], vectors[k, 2]
        for i in range(3):
            out[k, i] = R[i, 0] * x + R[i, 1] * y + R[i, 2] * z
