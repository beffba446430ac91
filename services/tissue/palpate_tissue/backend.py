"""What the service asks of the physics behind it: one class to write for another tissue."""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np
from numpy.typing import NDArray

from palpate_models.numerics.frames import Array
from palpate_models.patient.breathing import BreathingCurve
from palpate_models.patient.guarding import Activation
from palpate_models.patient.phantom import PhantomModel
from palpate_models.scenario import press


class TissueBackend(ABC):
    """A soft body with a skin of n vertices that a sphere presses. Everything is in the abdomen frame A and in SI units."""

    touching: bool = False
    """Whether the sphere holds a vertex after the step."""
    activation: float = 1.0
    """How far guarding muscles are contracted, from 0 to 1: the a of `palpate_models.patient.wall`."""

    def __init__(self, model: PhantomModel, breathing: BreathingCurve, dt: float) -> None:
        self.model = model
        """The body at rest."""
        self.dt = dt
        """Period of a step [s]."""
        self.breathing = breathing
        """How the body breathes."""
        self._guarding = Activation(model.voluntary, dt)

    @abstractmethod
    def step(self, t_s: float, p_A: Array, v_A: Array, radius: float, w_A: Array | None = None) -> tuple[Array, Array]:
        """Advances by one period to time `t_s` [s] with the sphere's centre at `p_A` [m], and returns the wrench on it.

        `v_A` [m/s] and `w_A` [rad/s] are the sphere's velocities, `radius` [m]. The result is the force [N] that the tissue
        exerts on the sphere and its torque about the centre [N m], each of shape (3,), the mean over the period. Raises
        ValueError for a position that is not finite.
        """

    @abstractmethod
    def idle(self, t_s: float) -> None:
        """Advances by one period to time `t_s` [s] with no sphere anywhere."""

    @abstractmethod
    def settle(self) -> None:
        """Brings the body to rest: as if nothing had ever touched it."""

    def in_steps_of(self, dt: float) -> TissueBackend:
        """The same body at rest, for steps of about `dt` [s] where its physics allows them; else this one, at rest, as it is."""
        self.settle()
        return self

    def press(self, places: Array, normals: Array, radius: float) -> tuple[Array, NDArray[np.bool_]]:
        """Standard presses with a sphere of `radius` [m], each into the body at rest, as it is afterwards.

        Guarding muscle is contracted at rest and does what it does under any press: involuntarily it stays, voluntarily it fades.
        `places` [m] on the skin at rest and outward unit `normals` there, shape (k, 3). Returns their apparent stiffness [N] and
        whether they ended at their limit, each of shape (k,). Here it is done step by step; faster ways are the subclass's.
        """
        at = press.times(self.dt)
        depths = press.depths(at)
        speeds = np.diff(depths, prepend=0.0) / self.dt
        forces = np.empty((len(places), len(at)))
        for k, (place, normal) in enumerate(zip(places, normals, strict=True)):
            self.settle()
            for i, depth in enumerate(depths):
                force, _ = self.step(float(at[i]), place + (radius - depth) * normal, -speeds[i] * normal, radius)
                forces[k, i] = force @ normal
        self.settle()
        return press.apparent_stiffness(forces)

    @property
    @abstractmethod
    def contacts(self) -> NDArray[np.intp]:
        """Vertices in contact after the step, shape (k,)."""

    @property
    @abstractmethod
    def deepest(self) -> tuple[int, float]:
        """The vertex in contact that is displaced most, and how far along its inward normal [m]. There has to be contact."""

    @property
    @abstractmethod
    def inward(self) -> Array:
        """How far each vertex is from its place at rest [m] along its inward normal, breathing included, shape (n,)."""

    @property
    def deformed_vertices(self) -> Array:
        """The surface as it is now [m], shape (n, 3)."""
        return self.model.vertices - self.inward[:, None] * self.model.normals

    def guard(self, v_A: Array) -> None:
        """Advances `activation` by a period, from how the sphere of velocity `v_A` [m/s] holds the skin: how each step ends."""
        if self._guarding.voluntary and self.touching:
            vertex, depth = self.deepest
            self.activation = self._guarding.after(self.activation, depth, -float(v_A @ self.model.normals[vertex]))

    def excursion(self, t_s: float) -> float:
        """Breathing excursion [m] at time `t_s` [s], outward positive, where the profile is 1."""
        return self.breathing.excursion(t_s)
