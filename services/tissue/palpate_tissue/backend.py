"""Interface of the tissue physics behind the service: implement `TissueBackend` for another tissue."""

from abc import ABC, abstractmethod
from math import isfinite

import numpy as np

from palpate_models.numerics.frames import Array, Indices, Mask
from palpate_models.patient.motion import BreathingCurve
from palpate_models.patient.phantom import PhantomModel
from palpate_models.patient.schema import Stiffness
from palpate_models.patient.wall import Activation
from palpate_models.scenario import press
from palpate_tissue.contact import VertexSearch, skin


class TissueBackend(ABC):
    """A soft body with a surface of n vertices, pressed by a sphere. Quantities are in the abdomen frame A and in SI units."""

    touching: bool = False
    """True if the sphere touched the surface in the last step."""
    activation: float = 1.0
    """Contraction of guarding muscles, 0 to 1: a in `palpate_models.patient.wall`."""

    def __init__(self, model: PhantomModel, breathing: BreathingCurve, dt: float) -> None:
        self.model = model
        self.dt = dt
        self.breathing = breathing
        self._guarding = Activation(model.voluntary, dt)

    @abstractmethod
    def step(self, t_s: float, p_A: Array, v_A: Array, radius: float, w_A: Array | None = None) -> tuple[Array, Array]:
        """Advance by one period to time `t_s` [s] with the sphere's centre at `p_A` [m]; return the wrench on it.

        `v_A` [m/s] and `w_A` [rad/s] are the sphere's velocities, `radius` [m]. The result is the force [N] on the sphere and the
        torque about its centre [N m], shapes (3,), averaged over the period. Raises ValueError for a motion that is not finite.
        """

    @abstractmethod
    def idle(self, t_s: float) -> None:
        """Advance by one period to time `t_s` [s] without contact."""

    @abstractmethod
    def settle(self) -> None:
        """Reset the body to its undisturbed rest state."""

    def in_steps_of(self, dt: float) -> "TissueBackend":
        """Return this body, at rest, for steps of about `dt` [s] if the physics allows them, else with its own steps."""
        self.settle()
        return self

    def press(self, places: Array, normals: Array, radius: float) -> tuple[Array, Mask]:
        """Perform standard presses with a sphere of `radius` [m], each into the body at rest, and leave it at rest.

        Guarding muscle is contracted at rest; involuntary contraction stays during a press, voluntary contraction fades.
        `places` [m] on the rest surface and outward unit `normals` there have shape (k, 3). Returns the apparent stiffness [N]
        and True where the force limit ended the press, shapes (k,). This implementation steps in time; subclasses may be faster.
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
    def contacts(self) -> Indices:
        """Return the indices of the vertices in contact after the step, shape (k,)."""

    @property
    @abstractmethod
    def deepest(self) -> tuple[int, float]:
        """Return the index of the most displaced vertex in contact and its inward displacement [m]. Requires contact."""

    @property
    @abstractmethod
    def inward(self) -> Array:
        """Return the displacement of each vertex from rest along its inward normal [m], with breathing, shape (n,)."""

    def guard(self, v_A: Array) -> None:
        """Advance `activation` by a period for a sphere of velocity `v_A` [m/s]. Each `step` ends with it."""
        if self._guarding.voluntary and self.touching:
            vertex, depth = self.deepest
            self.activation = self._guarding.after(self.activation, depth, -float(v_A @ self.model.normals[vertex]))

    def excursion(self, t_s: float) -> float:
        """Return the breathing excursion [m] at time `t_s` [s], outward positive, where the profile is 1."""
        return self.breathing.excursion(t_s)


class SkinBody(TissueBackend):
    """A body whose skin shears under the sphere; subclasses step its free vertices."""

    def __init__(
        self, model: PhantomModel, stiffness: Stiffness | None, breathing: BreathingCurve, dt: float, margin_m: float
    ) -> None:
        """`margin_m`: motion of the sphere after which the vertices near it are searched again."""
        super().__init__(model, breathing, dt)
        self._stiffness = stiffness or Stiffness()
        self.friction = skin(self._stiffness.friction, model.background)
        self.disturbed = False
        """True once anything has moved."""
        self._excursion = 0.0
        self._free = np.flatnonzero(~model.fixed)
        self._search = VertexSearch(model.vertices[self._free], model.normals[self._free], breathing.largest_m, margin_m)
        self._motion: Array = np.zeros((3, 3))
        """Rows: the sphere's centre [m], velocity [m/s] and angular velocity [rad/s]."""

    def step(self, t_s: float, p_A: Array, v_A: Array, radius: float, w_A: Array | None = None) -> tuple[Array, Array]:
        """See `TissueBackend`."""
        motion = self._motion
        motion[0], motion[1], motion[2] = p_A, v_A, 0.0 if w_A is None else w_A
        if not isfinite(sum(motion.ravel().tolist())):
            raise ValueError(f"tissue: position, velocity, angular velocity of the indenter are not finite: {motion.tolist()}")
        wrench = self._press(t_s, p_A.tolist(), radius)
        self.guard(v_A)
        return wrench[:3], wrench[3:]

    @abstractmethod
    def _press(self, t_s: float, p: list[float], radius: float) -> Array:
        """Advance by one period under `_motion`, to a sphere at `p` [m]; return force [N] and torque [N m] on it, shape (6,)."""

    def settle(self) -> None:
        """See `TissueBackend`."""
        self.friction.release()
        self.touching = self.disturbed = False
        self.activation, self._excursion = 1.0, 0.0

    def _set_touching(self, touching: bool) -> None:
        if self.touching and not touching:
            self.friction.release()
        self.touching = touching
