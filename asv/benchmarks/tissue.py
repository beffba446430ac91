"""A step of the tissue: an indenter of 15 mm radius slides at 30 mm/s and 10 mm depth."""

import math
from dataclasses import replace

import numpy as np

from palpate_errors import UserError
from palpate_models.numerics.frames import Array
from palpate_models.patient.phantom import PhantomModel, build_phantom, flat_phantom
from palpate_models.patient.schema import Lesion, Phantom, Stiffness
from palpate_models.patient.wall import Guarding
from palpate_tissue.backend import TissueBackend
from palpate_tissue.backends.elastic.compliance import compliance
from palpate_tissue.backends.elastic.tissue import ElasticTissue
from palpate_tissue.backends.winkler.tissue import WinklerTissue
from palpate_tissue.surface import SkinSurface


class Slide:
    """Steps along a path, forwards again from its start when it ends."""

    speed_mps, radius_m, depth_m, steps = 0.03, 0.015, 0.010, 200
    body: TissueBackend
    path: Array
    k = 0

    def step(self) -> None:
        """One step of 1 ms."""
        self.k += 1
        velocity = np.array((self.speed_mps, 0.0, 0.0))
        self.body.step(self.k * self.body.dt, self.path[self.k % len(self.path)], velocity, self.radius_m, np.zeros(3))


class Abdomen(Slide):
    """The default abdomen with one lesion."""

    params = (["surface", "elastic"], ["linear", "stiffening", "guarding"])
    param_names = ("tier", "wall")

    def setup(self, tier: str, wall: str) -> None:
        """Build the wall and the path over its surface."""
        lesion = Lesion(centre_m=(-0.055, 0.01), depth_m=0.01)
        muscles = (Guarding(centre_m=(-0.03, 0.01)),) if wall == "guarding" else ()
        phantom = Phantom(lesions=(lesion,), guarding=muscles)
        model = build_phantom(phantom, seed=0)
        if wall == "linear":
            model = replace(model, stiffening=np.zeros_like(model.stiffening))
        if tier == "surface":
            self.body = WinklerTissue(model, phantom.stiffness)
        else:
            self.body = ElasticTissue(model, compliance(model, phantom.lesions), phantom.stiffness)
        surface = SkinSurface(model)
        under = [surface.nearest(np.array((-0.06 + self.speed_mps * 1e-3 * k, 0.01, 0.0))) for k in range(self.steps)]
        self.path = np.array([place.position + (self.radius_m - self.depth_m) * place.normal for place in under])
        self.step()

    def time_step(self, *_: str) -> None:
        """One step in contact."""
        self.step()

    def track_contacts(self, *_: str) -> int:
        """Vertices in contact."""
        return len(self.body.contacts)


class FlatPatch(Slide):
    """A flat square of a given number of vertices, as large as an abdomen's front."""

    params = (["surface", "elastic"], [1_000, 3_000, 10_000, 50_000])
    param_names = ("tier", "vertices")

    def setup(self, tier: str, vertices: int) -> None:
        """Build the patch. Skips sizes that a tier refuses."""
        model = flat_patch(vertices)
        try:
            if tier == "surface":
                self.body = WinklerTissue(model, Stiffness())
            else:  # a layer of 0.2 m: the cost of a step does not depend on the entries of the matrix
                self.body = ElasticTissue(model, compliance(model, thickness_m=0.2), Stiffness())
        except UserError as error:
            raise NotImplementedError from error
        x = -self.speed_mps * 5e-4 * self.steps + self.speed_mps * 1e-3 * np.arange(self.steps)
        self.path = np.column_stack((x, np.full(self.steps, 0.001), np.full(self.steps, self.radius_m - self.depth_m)))
        self.step()

    def time_step(self, *_: object) -> None:
        """One step in contact."""
        self.step()

    def time_surface(self, *_: object) -> None:
        """Read the deformed surface."""
        _ = self.body.inward


def flat_patch(vertices: int, half_width_m: float = 0.13) -> PhantomModel:
    """Return a flat square of about `vertices` vertices, by default as large as an abdomen's front."""
    edge = 2 * half_width_m / math.sqrt(vertices * math.sqrt(3) / 2)
    return flat_phantom(half_width_m, edge)
