"""Intersection of each pixel's ray with a triangle mesh: rasterisation in homogeneous coordinates (Olano and Greer 1997).

A ray r = ((u - cx)/fx, (v - cy)/fy, 1) meets the plane of a triangle a, b, c (in C) at the inverse depth

    w = (e_a + e_b + e_c) . r,   e_a = (b x c) / d,  e_b = (c x a) / d,  e_c = (a x b) / d,  d = a . (b x c)

and does so inside of it, and before the camera, where none of e_a . r, e_b . r, e_c . r is negative. These are linear in u and
v, so a triangle that reaches behind the camera needs no clipping.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from palpate_models.numerics.compiled import compiled
from palpate_models.numerics.frames import Array

Image = NDArray[np.float32]
_NEAR_M = 1e-3
"""The image of a triangle with a corner nearer than this is looked for everywhere."""


@compiled
def _bounds(x: float, y: float, z: float, size: int) -> tuple[int, int]:
    """The pixels from the first to before the last that may lie between three coordinates."""
    low, high = min(x, y, z), max(x, y, z)
    return min(max(math.ceil(low), 0), size), min(max(math.floor(high) + 1, 0), size)


@compiled
def rasterise(p_C: Array, triangles: NDArray[np.uint32], lens: Array, w: Image, gu: Image, gv: Image, cos: Image) -> None:
    """Draws a mesh into a view where it is nearer: `w`, `gu`, `gv` and `cos` as in `scene.View`.

    `p_C`: vertices [m], shape (n, 3); `triangles`: shape (m, 3); `lens`: fx, fy, cx, cy [px].
    """
    fx, fy, cx, cy = lens
    height, width = w.shape
    e = np.empty((3, 3))
    slope = np.empty((3, 3))
    image = np.empty((len(p_C), 2))
    for i in range(len(p_C)):
        image[i, 0] = fx * p_C[i, 0] / p_C[i, 2] + cx
        image[i, 1] = fy * p_C[i, 1] / p_C[i, 2] + cy
    for i in range(len(triangles)):
        first, second, third = triangles[i, 0], triangles[i, 1], triangles[i, 2]
        u0, u1, v0, v1 = 0, width, 0, height
        if min(p_C[first, 2], p_C[second, 2], p_C[third, 2]) > _NEAR_M:
            u0, u1 = _bounds(image[first, 0], image[second, 0], image[third, 0], width)
            v0, v1 = _bounds(image[first, 1], image[second, 1], image[third, 1], height)
        if u0 >= u1 or v0 >= v1:
            continue
        a, b, c = p_C[first], p_C[second], p_C[third]
        for j in range(3):
            k, m = (j + 1) % 3, (j + 2) % 3
            e[0, j] = b[k] * c[m] - b[m] * c[k]
            e[1, j] = c[k] * a[m] - c[m] * a[k]
            e[2, j] = a[k] * b[m] - a[m] * b[k]
        d = a[0] * e[0, 0] + a[1] * e[0, 1] + a[2] * e[0, 2]
        if d == 0.0:  # seen edge-on
            continue
        for j in range(3):
            slope[j, 0] = e[j, 0] / (d * fx)
            slope[j, 1] = e[j, 1] / (d * fy)
            slope[j, 2] = e[j, 2] / d - slope[j, 0] * cx - slope[j, 1] * cy
        du, dv, at_0 = slope[:, 0].sum(), slope[:, 1].sum(), slope[:, 2].sum()
        normal = math.sqrt((fx * du) ** 2 + (fy * dv) ** 2 + (at_0 + du * cx + dv * cy) ** 2)
        for v in range(v0, v1):
            for u in range(u0, u1):
                inside = True
                for j in range(3):
                    inside = inside and slope[j, 0] * u + slope[j, 1] * v + slope[j, 2] >= 0.0
                near = du * u + dv * v + at_0
                if inside and near > w[v, u]:
                    ray = math.sqrt(((u - cx) / fx) ** 2 + ((v - cy) / fy) ** 2 + 1.0)
                    w[v, u], gu[v, u], gv[v, u], cos[v, u] = near, du, dv, near / (normal * ray)
