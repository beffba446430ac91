"""The set-points of a stroke: where along the path, how deep below the surface and with what force the indenter is to be."""

from __future__ import annotations

import numpy as np

from palpate_bus.setpoint import Setpoint
from palpate_models.numerics.frames import Array
from palpate_models.scenario.schema import Exam, Limits
from palpate_planning.contact import ContactMeasurement
from palpate_planning.depth import LIMITED_M, DepthRegulator, Regulation
from palpate_planning.motion.kinematics import ELBOW, TOO_STRAIGHT_RAD
from palpate_planning.motion.timing import JerkLimitedAxis
from palpate_planning.periods import SECOND
from palpate_planning.setpoints import NORMAL_STIFFNESS, cartesian_setpoint, joint_setpoint
from palpate_planning.strokes.path import ACCELERATION, PathPoint
from palpate_planning.strokes.segments import HOVER_M, Segment
from palpate_planning.wall.wall import Wall

DEPTH_ACCELERATION = 0.5
"""[m/s^2]"""
PLUNGE_MPS = 0.015
"""Speed of the descent near the surface and below it."""
TRANSFER_MPS = 0.15
"""Speed of the ways between strokes."""
TRANSFER_ACCELERATION = 0.8
"""[m/s^2]"""
CREEP_MPS = 1e-3
"""Least speed along a path: it is to arrive."""
ENDED_M = 1e-4
"""So near to its end a path is at its end."""
BRAKING = 0.75
"""Part of the acceleration with which the motion along a path brakes."""


def stroke_setpoint(t: int, point: PathPoint, rate: float, distance: float, sinking: float, push: float) -> Setpoint:
    """The set-point at `t` [ns] of a sphere that is at a point of a path.

    Args:
        t: time [ns].
        point: where the path is now.
        rate: speed along the path ds/dt [m/s].
        distance: of the sphere's centre from the surface along the outward normal [m].
        sinking: rate at which `distance` decreases [m/s].
        push: feed-forward force into the tissue [N].
    """
    p, n, R, q, dp, dn, w, dq = point
    V_WD, F_W = np.empty(6), np.zeros(6)
    V_WD[:3] = (dp + dn * distance) * rate - n * sinking
    V_WD[3:] = w * rate
    F_W[:3] = -n * push
    return cartesian_setpoint(t, R, p + n * distance, q, V_WD, F_W, dq * rate)


class StrokeMotion:
    """Moves the commanded indenter along one segment after the other, and up and down, within speed and acceleration."""

    def __init__(self, exam: Exam, limits: Limits, radius: float, period_s: float, wall: Wall) -> None:
        """`radius` of the sphere [m]; depth is counted from the `wall` where it is at the moment."""
        self._exam, self._limits, self._radius, self._period_s = exam, limits, radius, period_s
        self.wall = wall
        self._regulator = DepthRegulator(period_s, NORMAL_STIFFNESS, limits.force_working_n, limits.depth_m)
        self.regulation = Regulation(-HOVER_M, 0.0, -HOVER_M, 0.0, False, 0.0)
        self.depth = self._depth_axis(-HOVER_M)
        """Target depth [m], negative above the surface."""

    def _depth_axis(self, depth: float) -> JerkLimitedAxis:
        self._regulator.reset(depth)
        return JerkLimitedAxis(depth, DEPTH_ACCELERATION, DEPTH_ACCELERATION / 0.05, self._period_s)

    def _path_axis(self, position: float) -> JerkLimitedAxis:
        return JerkLimitedAxis(position, self._acceleration, 10 * self._acceleration, self._period_s)

    # --- where on which segment ---------------------------------------------------------------------------------------

    def start(self, segment: Segment) -> None:
        """At rest at the start of a segment."""
        self.segment = segment
        speed = self._exam.speed_mps if segment.contact else TRANSFER_MPS
        self._speed_limit = segment.path.speed_limit(speed, self._limits)
        self._acceleration = ACCELERATION if segment.contact else TRANSFER_ACCELERATION
        self.along = self._path_axis(0.0)
        """Path length travelled [m]."""
        self._sample = 0.0
        self._going = True
        """Whether the free motion goes on."""
        self._aside: Array | None = None
        """Where the arm was at the start of a free motion, less where that begins [rad], shape (7,); None before it is known."""
        self._deepest = self._exam.depth_m if segment.depth_m is None else segment.depth_m

    def restart(self, contact: ContactMeasurement) -> None:
        """At rest where the segment was left, at the depth at which the arm is now."""
        self.depth = self._depth_axis(contact.depth)
        self.along = self._path_axis(self.along.position)

    def shift(self, outward: float) -> None:
        """The wall is found to be `outward` [m] of where it was counted from: the commanded position stays where it is."""
        self.depth.shift(outward)
        self._regulator.shift(outward)

    @property
    def point(self) -> PathPoint:
        """Where the path is now."""
        return self.segment.path.at(self.along.position)

    @property
    def target(self) -> int:
        """Index of the latest target reached."""
        return self.segment.path.target(self.along.position + 1e-6)

    def centre_height(self, t: int) -> float:
        """Distance of the sphere's centre from the perceived surface at zero depth, at `t` [ns]; in metres."""
        return self._radius + self.wall.outward(self.point.p, t)

    def free_height(self, t: int) -> float:
        """Height [m] above the skin at `t` [ns] for free motions, which keep clear of where the skin was seen, too."""
        return HOVER_M + max(0.0, -self.wall.outward(self.point.p, t))

    @property
    def ended(self) -> bool:
        """Whether the path has been followed to its end."""
        return self.along.position > self.segment.path.length - ENDED_M

    @property
    def stopping_distance(self) -> float:
        """Path length needed to come to rest [m]."""
        return self.along.velocity**2 / (2 * BRAKING * self._acceleration)

    def bend_needed(self, q: Array) -> float:
        """How far the plan must bend the elbow [rad] for it not to become too straight, with the arm at joint positions q [rad].

        The square of the bend falls in proportion to how far the arm reaches. Where the skin lies deeper, or further off, than it
        was seen, it is less than planned, and will be by as much on what is ahead.
        """
        lost = self.point.q[ELBOW] ** 2 - q[ELBOW] ** 2
        return float(np.sqrt(max(TOO_STRAIGHT_RAD**2 + lost, 0.0)))

    @property
    def bend_ahead(self) -> float:
        """How far the plan bends the elbow where the motion along the path can come to rest [rad]."""
        return float(abs(self.segment.path.at(self.along.position + self.stopping_distance).q[ELBOW]))

    # --- one period of motion -----------------------------------------------------------------------------------------

    def slowdown(self, full: float, none: float, floor: float) -> float:
        """Part of the speed that the expected force leaves: 1 below `full` of the force limit, none at `none`, yet `floor`."""
        force = self.regulation.expected_force / self._regulator.force_max
        return min(max((none - force) / (none - full), floor), 1.0)

    def deepen(self) -> bool:
        """Sinks towards full depth, the slower the nearer the force is to its limit; returns whether it is there."""
        return self.depth.step(self._deepest, PLUNGE_MPS * self.slowdown(0.7, 1.0, 0.01))

    def slide(self) -> bool:
        """Follows the path in contact, slower where force rises; returns whether it is at its end."""
        allowed = self._speed_limit.at(self.along.position + self.along.velocity * self._period_s)
        return self.along.step(self.segment.path.length, max(allowed * self.slowdown(1.0, 1.1, 0.3), CREEP_MPS))

    def travel(self, goal: float) -> bool:
        """Follows the path above the surface to path length `goal` [m]; returns whether it is there."""
        return self.along.step(goal, max(self._speed_limit.at(self.along.position), CREEP_MPS))

    def brake(self) -> None:
        """Comes to rest along the path; a free motion stays where it is."""
        self._going = False
        if self.along.velocity > 1e-4:
            self.along.step(self.along.position + self.stopping_distance, max(self.along.velocity, CREEP_MPS))

    def _free_setpoint(self, t: int, contact: ContactMeasurement, rate: float) -> Setpoint:
        """A free motion that begins where the arm is, and fades to the planned one: s(x) = 1 - x^2 (3 - 2 x) of the difference.

        It was planned from where the wall was believed to be, before touches. A centimetre off, the elbow of a stretched arm is
        0.1 rad from there, and a step of the set-point would drive it faster than its limit.
        """
        free = self.segment.free
        assert free is not None
        last = len(free) - 1
        q, qd = free.at(self._sample)
        if self._aside is None:
            self._aside = contact.q - free.q[0]
        x = self._sample / last if last else 1.0
        left, fading = 1 - x * x * (3 - 2 * x), -6 * x * (1 - x) / (max(last, 1) * self._period_s)
        return joint_setpoint(t, contact.X_WI, q + left * self._aside, rate * (qd + fading * self._aside))

    def follow_free_motion(self, rate: float) -> bool:
        """Goes on by `rate` samples of the segment's free motion; returns whether it is at its end."""
        assert self.segment.free is not None
        last = len(self.segment.free) - 1.0
        self._going = True
        self._sample = min(self._sample + rate, last)
        return self._sample >= last

    def regulate(self, contact: ContactMeasurement, *, in_contact: bool, pushing: bool) -> None:
        """Regulates the measured depth towards the target depth.

        `in_contact` lets errors be integrated, `pushing` the force be fed forward: on the way above the skin nothing that comes
        against the tool is pushed back.
        """
        force = contact.force if pushing else 0.0
        self.regulation = self._regulator.update(self.depth.position, contact.depth, force, contact.load, in_contact)

    @property
    def short_of_depth(self) -> bool:
        """Whether the target depth has not reached the depth of the examination."""
        return self.depth.position < self._deepest - LIMITED_M

    def setpoint(self, t: int, contact: ContactMeasurement, rate: float) -> Setpoint:
        """The set-point at `t` [ns]; a free motion goes on by `rate` samples a period."""
        if self.segment.free is not None:
            return self._free_setpoint(t, contact, rate if self._going else 0.0)
        regulation, point, speed, dt = self.regulation, self.point, self.along.velocity, self._period_s
        outward = self.wall.outward(point.p, t)
        rising = (self.wall.outward(point.p + point.dp * speed * dt, t + round(dt * SECOND)) - outward) / dt
        distance = self._radius + outward - regulation.depth
        return stroke_setpoint(t, point, speed, distance, regulation.rate - rising, regulation.force)
