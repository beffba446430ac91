"""Interface of a simulated arm: physics engines behind the same driver and sensors."""

from typing import Final, Protocol

from palpate_models.numerics.frames import Array
from palpate_models.scenario.errors import DrawnArm
from palpate_models.scenario.schema import Robot

DT: Final = 1e-3
"""Step [s]."""
END_STOP_MARGIN_RAD: Final = 0.03
"""Distance of the mechanical end stop behind the position limit (assumed); the driver acts at the limit."""
STICK_RADPS: Final = 1e-3
"""Speed below which friction is viscous: a joint loaded below its Coulomb friction creeps slower than this (assumed)."""


Wrench = tuple[float, float, float, float, float, float]


class Plant(Protocol):
    """The arm with its tool. Arrays of joints have shape (n,), from the base to the flange; units N, N m, m, rad, s."""

    q: Array
    """Joint positions [rad], a fresh array at every step."""
    v: Array
    """Joint velocities [rad/s], a fresh array at every step."""
    friction: Array
    """Torque of friction and of the driver's damping in the last step [N m], a fresh array: the drives' torque less this is on
    the links."""

    def step(self, torque: Array, force_W: Array | None, moment_W: Array, damping: Array) -> None:
        """Advance 1 ms under joint torques (gravity not compensated), the driver's damping, and a wrench on the indenter.

        `damping` [N m s/rad], shape (n,), comes on top of the friction. The wrench, shapes (3,), acts at the sphere's
        centre, in world axes, and is held over the step; None for the force where nothing touches.
        """

    def gravity_torque(self) -> Array:
        """Return the joint torques that compensate gravity [N m], shape (n,), with the nominal tool mass."""

    def sensor_wrench(self) -> Wrench:
        """Return the wrench on the F/T sensor from the tool below it: force [N], then moment [N m], in sensor axes."""

    def tool_motion(self) -> Array:
        """Return the indenter's motion in world: position p_WI [m], orientation x, y, z, w, velocities [m/s, rad/s], shape (13,).

        The linear velocity is that of the sphere's centre.
        """

    def link_poses(self) -> Array:
        """Return the poses of all links in world: position [m], orientation x, y, z, w, shape (n + 4, 7)."""


class PlantFactory(Protocol):
    """Creates the plant of a scenario's robot."""

    def __call__(self, robot: Robot, *, drawn: DrawnArm) -> Plant:
        """Return a plant at rest at home: the nominal robot with the arm errors `drawn`."""
