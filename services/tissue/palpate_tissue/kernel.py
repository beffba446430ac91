"""The compiled part of the tissue's step: loops over vertices, in the order that the FMU's C source has them.

Compiled once by numba (`palpate_models.compiled`).
"""

from __future__ import annotations

from math import sqrt

import numpy as np
from numpy.typing import NDArray
from palpate_models.compiled import compiled

Array = NDArray[np.float64]
Index = NDArray[np.uint32]
"""Unsigned: a signed index may be negative to numba, and looking each time doubles the cost of the field's step."""


@compiled
def relax(indptr: Index, indices: Index, rate: Array, branches: Array, strain: Array, u: Array) -> None:
    """The field as it moves by itself over a step: u += A (u - sum_k y_k), A in CSR form, `branches` of shape (k, n)."""
    n = u.shape[0]
    for i in range(n):
        strain[i] = u[i]
    for k in range(branches.shape[0]):
        for i in range(n):
            strain[i] -= branches[k, i]
    for i in range(n):
        total = u[i]
        for j in range(indptr[i], indptr[i + 1]):
            total += rate[j] * strain[indices[j]]
        u[i] = total


@compiled
def remember(branches: Array, decay: Array, feed: Array, u: Array) -> None:
    """The Prony branches, exact for a displacement held over the step: y_k = decay_k y_k + feed_k u."""
    for k in range(branches.shape[0]):
        fade, gain = decay[k], feed[k]
        for i in range(u.shape[0]):
            branches[k, i] = branches[k, i] * fade + gain * u[i]


@compiled
def hold(
    index: Index,
    normals: Array,
    positions: Array,
    breathing: Array,
    gain: Array,
    q: Array,
    radius: float,
    rim: float,
    excursion: float,
    u: Array,
    f: Array,
    out: Array,
) -> float:
    """Holds the vertices under the sphere on its surface; returns the sum of their forces [N].

    `positions` (m, 3) and the sphere's centre `q` (3,) share an origin. Vertices whose surface makes an angle with a cosine
    below `rim` with the tangent plane are left alone. `f` (m,) gets each vertex's force along its inward normal [N];
    `out` (9,) the force on the sphere [N], the sum of f times outward normals [N], and the arm of the contact's centre
    from the sphere's [m].
    """
    load = fx = fy = fz = nx = ny = nz = rx = ry = rz = 0.0
    square_radius = radius * radius
    least = square_radius * rim * rim
    for k in range(index.shape[0]):
        f[k] = 0.0
        dx, dy, dz = q[0] - positions[k, 0], q[1] - positions[k, 1], q[2] - positions[k, 2]
        x, y, z = normals[k, 0], normals[k, 1], normals[k, 2]
        below = -(x * dx + y * dy + z * dz)
        square = square_radius - (dx * dx + dy * dy + dz * dz) + below * below  # R^2 - lateral distance^2
        if square <= least:
            continue
        half = sqrt(square)
        rest = below + half
        i = index[k]
        gap = rest + excursion * breathing[k] - u[i]
        if gap <= 0.0:
            continue
        u[i] += gap
        force = gap * gain[k]
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
