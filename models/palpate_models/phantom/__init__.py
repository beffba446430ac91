"""Phantoms: a rest surface with a stiffness field, parametric or from a mesh file.

    model = build_phantom(scenario.phantom, scenario.seed)

`PhantomModel` is arrays only; the mechanics are in the tissue service. Quadrants are named by `quadrant(x, y)`.
"""

from __future__ import annotations

from palpate_models.phantom.flat import flat_phantom
from palpate_models.phantom.mesh import MeshError
from palpate_models.phantom.model import PhantomModel, build_phantom, quadrant

__all__ = ["MeshError", "PhantomModel", "build_phantom", "flat_phantom", "quadrant"]
