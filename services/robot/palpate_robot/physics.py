"""What the service needs of a simulated arm, so that another physics engine can stand behind the same driver and sensor."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final, Protocol

from palpate_models.frames import Array
from palpate_models.scenario import Robot

DT: Final = 1e-3
"""Step [s]."""
GRAVITY: Final = 9.81
"""[m/s^2], along -z of world."""
END_STOP_MARGIN_RAD: Final = 0.03
"""How far behind the position limit the mechanical end stop is [A]; the driver acts at the limit."""
STICK_RADPS: Final = 1e-3
"""Below this speed friction is viscous: a joint under less than its friction creeps slower than this [A]."""
FIXED_LINKS: Final = ("lbr_link_0", "lbr_link_1")
"""Links that stand on or turn over the base and so have no collision shapes."""


class Orientation(Protocol):
    """A unit quaternion."""

    def w(self) -> float:
        """Its real part."""
        ...

    def x(self) -> float:
        """Its imaginary parts ..."""
        ...

    def y(self) -> float:
        """... in turn ..."""
        ...

    def z(self) -> float:
        """... about x, y and z."""
        ...


class Physics(Protocol):
    """The arm with its tool. Arrays of joints have shape (7,), order lbr_A1..lbr_A7; units N, N m, m, rad, s."""

    q: Array
    """Joint positions [rad], a fresh array at every step."""
    v: Array
    """Joint velocities [rad/s], a fresh array at every step."""

    def reset(self, q: Sequence[float] | Array, v: Sequence[float] | Array | None = None) -> None:
        """Puts the arm at joint positions `q` [rad] and velocities `v` [rad/s], by default at rest."""
        ...

    def step(self, torque: Array, force_W: Array | None, moment_W: Array, damping: Array) -> None:
        """Advances 1 ms under joint torques (gravity not compensated), the driver's damping, and a wrench on the indenter.

        `damping` [N m s/rad], shape (7,), comes on top of the friction. The wrench, shapes (3,), acts at the sphere's
        centre, in world axes, and is held over the step; None for the force where nothing touches.
        """
        ...

    def gravity_torque(self) -> Array:
        """Joint torques that carry the arm's and the tool's weight here [N m], shape (7,)."""
        ...

    def sensor_wrench(self) -> Array:
        """Wrench that what is below the F/T sensor exerts on it: force [N], then moment [N m], shape (6,), in its axes."""
        ...

    def tool_pose(self) -> tuple[Array, Orientation]:
        """Position p_WI [m], shape (3,), and orientation of the indenter in world."""
        ...

    def tool_twist(self) -> tuple[Array, Array]:
        """Linear velocity [m/s] of the sphere's centre and angular velocity [rad/s], world axes, shapes (3,)."""
        ...

    def link_pose(self, link: str) -> tuple[Array, Orientation]:
        """Position [m], shape (3,), and orientation of a link of `lbr.LINK_NAMES` in world."""
        ...

    def contacts(self) -> int:
        """Number of contact points with table or base in the last step."""
        ...


Factory = Callable[[Robot], Physics]
