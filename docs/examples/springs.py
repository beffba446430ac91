"""A tissue: a bed of independent springs, one under each point of the skin."""

import numpy as np

from palpate_models.scenario import press
from palpate_tissue.backend import TissueBackend
from palpate_tissue.service import simulated


class Springs(TissueBackend):
    """A point of modulus k and area A, displaced by u along its normal, pushes back with k A u."""

    def step(self, t_s, p_A, v_A, radius, w_A=None):
        """Return force [N] and torque about the centre [N m] on the sphere at p_A, abdomen frame."""
        normals = self.model.normals
        lifted = self.excursion(t_s) * self.model.breathing  # outward, by breathing
        from_centre = self.model.vertices + lifted[:, None] * normals - p_A
        along = np.einsum("ij,ij->i", from_centre, normals)
        inside = radius**2 - np.einsum("ij,ij->i", from_centre, from_centre)
        below = np.sqrt(np.maximum(inside + along**2, 0))  # centre to underside, along the normal
        held = inside > 0
        pressed = np.where(held, along + below, 0.0)
        self._inward, self._contacts = pressed - lifted, np.flatnonzero(held)
        self.touching = bool(len(self._contacts))
        force = self.model.stiffness * self.model.areas * pressed / np.where(held, below, 1.0)
        to_centre = pressed[:, None] * normals - from_centre  # without friction the force points to the centre
        return force @ to_centre, np.zeros(3)

    def idle(self, t_s):
        """Without a sphere the surface only breathes."""
        self._inward = -self.excursion(t_s) * self.model.breathing
        self._contacts, self.touching = np.empty(0, np.intp), False

    def settle(self):
        """Springs have no memory."""
        self.idle(0.0)

    def press(self, places, normals, radius):
        """Return apparent stiffness of standard presses; without memory only their full depth matters."""
        still = np.zeros(3)
        spheres = places + (radius - press.DEPTH_M) * normals
        forces = [self.step(0.0, p, still, radius)[0] @ n for p, n in zip(spheres, normals, strict=True)]
        return press.apparent_stiffness(np.array(forces)[:, None])

    contacts = property(lambda self: self._contacts)
    inward = property(lambda self: self._inward)

    @property
    def deepest(self):
        """Return the contact vertex of largest displacement and its displacement [m]."""
        vertex = int(self._contacts[np.argmax(self._inward[self._contacts])])
        return vertex, float(self._inward[vertex])


def create(scenario):
    """Return the service of the role `tissue`."""

    def make(model, breathing, period_s):
        springs = Springs(model, breathing, dt=period_s)
        springs.settle()
        return springs, {}

    return simulated(scenario, make)
