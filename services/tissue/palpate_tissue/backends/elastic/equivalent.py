"""What stiffness the skin shows: the truth that a surface map of a body with depth can be scored against.

At every vertex a sphere of the exam's radius is pressed to the exam's depth into the elastic body (instantaneous, along the
vertex's normal). The equivalent foundation modulus there is that of the uniform body, of the same skin, which answers with the
same force:  k_eq = k_uniform F / F_uniform.  It is done with the lesions and without them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from palpate_models.frames import Array
from palpate_models.patient import Lesion
from palpate_models.phantom import PhantomModel
from palpate_models.phantom.field import edge_distance
from palpate_tissue.backends.elastic.cache import content_key, remembered
from palpate_tissue.backends.elastic.compliance import Compliance, uniform_compliance
from palpate_tissue.backends.elastic.contact import ContactSolver

LEAST_EFFECT = 0.02
"""A lesion that changes the skin's stiffness by less nowhere is not in the truth's mask."""


def with_equivalent_stiffness(
    model: PhantomModel, lesions: Sequence[Lesion], body: Compliance, healthy: Compliance, radius_m: float, depth_m: float
) -> PhantomModel:
    """The phantom with its stiffness and background as the skin shows them at `depth_m` [m] under a sphere of `radius_m` [m].

    A vertex belongs to the lesion whose outline is nearest where the lesions' effect is at least half of its greatest there.
    """
    arrays = (model.vertices, model.normals, model.areas, model.background, model.fixed)
    key = content_key("equivalent", *arrays, tuple(lesions), radius_m, depth_m, float(body.matrix.sum()))

    def compute() -> Array:
        uniform, k_w = uniform_compliance(model)
        reference = pressed_forces(model, uniform, radius_m, depth_m)
        return k_w * np.stack([pressed_forces(model, c, radius_m, depth_m) for c in (body, healthy)]) / reference

    shown, background = remembered(key, compute)
    stiffness, healthy_stiffness = model.background.copy(), model.background.copy()
    stiffness[body.free], healthy_stiffness[body.free] = shown, background
    label = _labels(model, stiffness / healthy_stiffness, lesions)
    return replace(model, stiffness=stiffness, background=healthy_stiffness, lesion=label)


def pressed_forces(model: PhantomModel, body: Compliance, radius_m: float, depth_m: float) -> Array:
    """Force [N] at each free vertex on a sphere pressed there to `depth_m` [m] along its normal, shape (f,)."""
    vertices, normals = model.vertices[body.free], model.normals[body.free]
    tree = cKDTree(vertices)
    forces = np.empty(len(vertices))
    for i, (place, normal) in enumerate(zip(vertices, normals, strict=True)):
        centre = place + (radius_m - depth_m) * normal
        near = np.asarray(tree.query_ball_point(centre, radius_m), dtype=np.intp)
        offset = centre - vertices[near]
        below = -(offset * normals[near]).sum(axis=1)
        square = radius_m**2 + below**2 - (offset**2).sum(axis=1)  # of the half chord of the sphere along the normal
        hold = below + np.sqrt(np.maximum(square, 0.0))
        solver = ContactSolver(body.matrix[np.ix_(near, near)].astype(np.float64))
        solver.begin_with(hold > 0.4 * depth_m)
        forces[i] = solver.solve(hold)[0].sum()
    return forces


def _labels(model: PhantomModel, ratio: Array, lesions: Sequence[Lesion]) -> NDArray[np.int32]:
    label = np.full(len(ratio), -1, dtype=np.int32)
    if not lesions:
        return label
    front = (model.normals[:, 2] > 0.3) & ~model.fixed
    distance = np.stack([edge_distance(model.vertices[:, :2], lesion) for lesion in lesions])
    owner = distance.argmin(axis=0)
    effect = np.abs(ratio - 1)
    for index, lesion in enumerate(lesions):
        own = front & (owner == index) & (distance[index] < 0.5 * max(lesion.radii_m) + (lesion.depth_m or 0.0))
        peak = effect[own].max(initial=0.0)
        if peak >= LEAST_EFFECT:
            label[own & (effect >= 0.5 * peak)] = index
    return label
