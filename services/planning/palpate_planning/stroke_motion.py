"""Motion of the commanded indenter in a stroke: position along the path, depth below the wall, feed-forward force."""

from typing import Final, NamedTuple

import numpy as np

from palpate_bus.setpoint import Setpoint
from palpate_models.numerics.frames import Array
from palpate_models.robot.arm import arm_of, tool_pose
from palpate_models.scenario.schema import CommandLevel, Exam, Limits, Robot
from palpate_planning.contact import ContactMeasurement
from palpate_planning.depth import DEPTH, DepthRegulator, Regulation
from palpate_planning.motion.kinematics import KINEMATIC_LIMITS
from palpate_planning.motion.planner import JerkLimitedAxis
from palpate_planning.periods import SECOND
from palpate_planning.setpoints import NORMAL_STIFFNESS, cartesian_setpoint, joint_setpoint
from palpate_planning.strokes.path import LIMITS, PathPoint
from palpate_planning.strokes.plan import SEGMENTS, Segment
from palpate_planning.wall.wall import Wall


class MotionTuning(NamedTuple):
    """Speeds and accelerations of the commanded indenter."""

    depth_acceleration_mps2: float = 0.5
    plunge_mps: float = 0.015
    """Speed of the descent in tissue."""
    transfer_mps: float = 0.15
    """Speed between strokes."""
    transfer_acceleration_mps2: float = 0.8
    creep_mps: float = 1e-3
    """Minimum speed along a path."""
    end_tolerance_m: float = 1e-4
    braking_fraction: float = 0.75
    """Fraction of the acceleration with which the motion along a path brakes."""
    behind_rad: float = 0.1
    """A free motion has arrived when no joint is this far behind: a real arm may be slowed down by its own controller."""
    behind_m: float = 0.015
    """Nor may the tool be this far behind: the stroke that follows begins where the tool is."""
    posture_radps: float = 10.0
    """Maximum speed of the posture in set-points of contact: near a singular wrist, that at the end of a path and that at the
    start of the next stroke are far apart."""
    stopped_speed_fraction: float = 0.1
    """Below this fraction of its speed the descent counts as stopped by force."""


MOTION: Final = MotionTuning()


def stroke_setpoint(t: int, point: PathPoint, rate: float, distance: float, sinking: float, push: float) -> Setpoint:
    """Return the set-point of a sphere at a point of a path.

    Args:
        t: time [ns].
        point: present point of the path.
        rate: speed along the path ds/dt [m/s].
        distance: of the sphere's centre from the perceived surface along the outward normal [m].
        sinking: rate at which `distance` decreases [m/s].
        push: feed-forward force into the tissue [N].
    """
    V_WD, F_W = np.empty(6), np.zeros(6)
    V_WD[:3] = (point.dp_ds + point.dn_ds * distance) * rate - point.n_W * sinking
    V_WD[3:] = point.dphi_ds * rate
    F_W[:3] = -point.n_W * push
    p_WD = point.p_W + point.n_W * distance
    return cartesian_setpoint(t, point.R_WD, p_WD, point.q, V_WD, F_W, point.dq_ds * rate)


def is_behind(q: Array, X_WI: Array, contact: ContactMeasurement) -> bool:
    """Return True if the arm is far from a set-point of free motion: joint positions q [rad], shape (n,), pose X_WI."""
    away_m = float(np.linalg.norm(X_WI[:3, 3] - contact.X_WI[:3, 3]))
    return away_m >= MOTION.behind_m or bool(np.abs(q - contact.q).max() >= MOTION.behind_rad)


class StrokeMotion:
    """Moves the commanded indenter along segments and up and down, within limits of speed and acceleration."""

    def __init__(self, exam: Exam, limits: Limits, robot: Robot, period_s: float, wall: Wall) -> None:
        """Depth is measured from the present `wall`."""
        self._exam, self._limits, self._radius, self._arm = exam, limits, robot.indenter_radius_m, arm_of(robot)
        self._robot = robot
        self.period_s, self.speed_mps, self.wall = period_s, exam.speed_mps, wall
        self._regulator = DepthRegulator(period_s, NORMAL_STIFFNESS, limits.force_working_n, limits.depth_m)
        self.regulation = Regulation(-SEGMENTS.hover_m, 0.0, -SEGMENTS.hover_m, 0.0, False, 0.0)
        self.depth_axis = self._new_depth_axis(-SEGMENTS.hover_m)
        """Target depth [m], negative above the wall."""
        self.posture: Array | None = None
        """Posture of the last set-point [rad], shape (n,); None: of an arm that another motion has moved, as measured."""
        self.joined = False
        """True if the commanded depth continues that of the arm; after a free motion it has to be measured first."""

    def _new_depth_axis(self, depth: float) -> JerkLimitedAxis:
        self._regulator.reset(depth)
        return JerkLimitedAxis(depth, MOTION.depth_acceleration_mps2, MOTION.depth_acceleration_mps2 / 0.05, self.period_s)

    def _path_axis(self, position: float) -> JerkLimitedAxis:
        return JerkLimitedAxis(position, self._acceleration, 10 * self._acceleration, self.period_s)

    # --- position on the segment --------------------------------------------------------------------------------------

    def start(self, segment: Segment) -> None:
        """Begin a segment, at rest."""
        self.segment = segment
        self.joined = self.joined and segment.free is None
        speed = self.speed_mps if segment.contact else min(MOTION.transfer_mps, self._limits.speed_mps)
        wanted = LIMITS.acceleration_mps2 if segment.contact else MOTION.transfer_acceleration_mps2
        velocity, acceleration = self._limits.joint_velocity_scale * self._arm.velocity_radps, self._arm.acceleration_radps2
        if self._robot.level is not CommandLevel.POSITION:
            acceleration = np.full_like(acceleration, np.inf)  # an arm with an impedance lags behind and does not overshoot
        self._acceleration = segment.path.acceleration_limit(wanted, acceleration)
        self._speed_limit = segment.path.speed_limit(speed, velocity, acceleration, self._acceleration)
        self.along = self._path_axis(0.0)
        """Path length travelled [m]."""
        self._sample = 0.0
        self._behind = False
        """True if the arm is far from the set-point of a free motion."""
        self._q_offset: Array | None = None
        """Measured less planned joint positions at the start of a free motion [rad], shape (n,); None until then."""
        self._deepest = self._exam.depth_m if segment.depth_m is None else segment.depth_m

    def join(self, contact: ContactMeasurement) -> None:
        """Begin at the depth of the arm, unless the commanded depth continues it already."""
        if not self.joined:
            self.depth_axis, self.joined = self._new_depth_axis(contact.depth), True

    def restart(self, contact: ContactMeasurement) -> None:
        """Continue the segment from rest where it was left, at the present depth and posture of the arm."""
        self.depth_axis, self.posture = self._new_depth_axis(contact.depth), None
        self.along = self._path_axis(self.along.position)

    def shift(self, outward: float) -> None:
        """Count depth from a wall that is `outward` [m] of the previous estimate; the commanded position stays."""
        self.depth_axis.shift(outward)
        self._regulator.shift(outward)

    @property
    def point(self) -> PathPoint:
        """Present point of the path."""
        return self.segment.path.at(self.along.position)

    @property
    def target(self) -> int:
        """Index of the latest target reached."""
        return self.segment.path.target(self.along.position + 1e-6)

    def centre_height(self, t: int) -> float:
        """Return the distance [m] of the sphere's centre from the perceived surface at zero depth, at `t` [ns]."""
        return self._radius + self.wall.outward(self.point.p_W, t)

    def free_height(self, t: int) -> float:
        """Return the height [m] above the wall at `t` [ns] for free motions, which keep clear of the perceived surface, too."""
        return SEGMENTS.hover_m + max(0.0, -self.wall.outward(self.point.p_W, t))

    @property
    def ended(self) -> bool:
        """True if the path has been followed to its end."""
        return self.along.position > self.segment.path.length - MOTION.end_tolerance_m

    @property
    def stopping_distance(self) -> float:
        """Path length needed to come to rest [m]."""
        return self.along.velocity**2 / (2 * MOTION.braking_fraction * self._acceleration)

    def bend_needed(self, q: Array) -> float:
        """Return the bend [rad] that a plan needs for the elbow not to become too straight, at measured joint positions q [rad].

        The square of the bend falls in proportion to the arm's reach. Where the wall is deeper or more lateral than perceived,
        the elbow bends less than planned, and will do so by as much on the rest of the plan.
        """
        lost = self._arm.bend(self.point.q) ** 2 - self._arm.bend(q) ** 2
        return float(np.sqrt(max(KINEMATIC_LIMITS.too_straight_rad**2 + lost, 0.0)))

    @property
    def bend_ahead(self) -> float:
        """Planned bend of the elbow where the motion along the path can come to rest [rad]."""
        return abs(self._arm.bend(self.segment.path.at(self.along.position + self.stopping_distance).q))

    # --- one period of motion -----------------------------------------------------------------------------------------

    def _slowdown(self, full: float, none: float, floor: float) -> float:
        """Return the fraction of speed that the force allows: 1 below `full` of its limit, 0 at `none`, but at least `floor`."""
        force = self.regulation.expected_force / self._regulator.force_max
        return min(max((none - force) / (none - full), floor), 1.0)

    @property
    def stopped_by_force(self) -> bool:
        """True if the force leaves the descent almost no speed."""
        return self._slowdown(0.7, 1.0, 0.0) < MOTION.stopped_speed_fraction

    def move_depth(self, depth: float, speed: float) -> bool:
        """Move to `depth` [m] with at most `speed` [m/s] and the speed limit of free motion; return True once there."""
        return self.depth_axis.step(depth, min(speed, self._limits.speed_mps))

    def deepen(self) -> bool:
        """Sink towards full depth, slower near the force limit; return True if it is reached."""
        return self.depth_axis.step(self._deepest, MOTION.plunge_mps * self._slowdown(0.7, 1.0, 0.01))

    def slide(self) -> bool:
        """Follow the path in contact, slower above the force limit; return True at its end."""
        allowed = self._speed_limit.at(self.along.position + self.along.velocity * self.period_s)
        speed = max(allowed * self._slowdown(1.0, 1.1, 0.3), MOTION.creep_mps)
        return self.along.step(self.segment.path.length, speed)

    def travel(self, goal: float) -> bool:
        """Follow the path above the wall to path length `goal` [m]; return True once there."""
        return self.along.step(goal, max(self._speed_limit.at(self.along.position), MOTION.creep_mps))

    def brake(self) -> bool:
        """Come to rest along the path; return True at rest."""
        resting = self.along.velocity <= 1e-4
        if not resting:
            self.along.step(self.along.position + self.stopping_distance, max(self.along.velocity, MOTION.creep_mps))
        return resting

    def follow_free_motion(self, rate: float) -> bool:
        """Advance the segment's free motion by `rate` samples; return True once the arm is at its end."""
        assert self.segment.free is not None
        last = len(self.segment.free) - 1.0
        self._sample = min(self._sample + rate, last)
        return self._sample >= last and not self.behind

    @property
    def behind(self) -> bool:
        """True if the arm is not yet at the end of a free motion whose set-points are."""
        free = self.segment.free
        return free is not None and self._sample >= len(free) - 1.0 and self._behind

    def regulate(self, contact: ContactMeasurement, *, in_contact: bool, pushing: bool) -> None:
        """Regulate the measured depth towards the target depth.

        `in_contact` enables the integral of the error, `pushing` the feed-forward of force: above the wall the tool does not
        push back.
        """
        if self.segment.free is not None:  # the stroke after it begins where the arm is then
            self.depth_axis = self._new_depth_axis(contact.depth)
        force, target = contact.force if pushing else 0.0, self.depth_axis.position
        self.regulation = self._regulator.update(
            target_m=target, depth_m=contact.depth, normal_force_n=force, load_n=contact.load, in_contact=in_contact
        )

    @property
    def short_of_depth(self) -> bool:
        """True if the target depth has not reached the depth of the examination."""
        return self.depth_axis.position < self._deepest - DEPTH.limited_m

    # --- the set-point ------------------------------------------------------------------------------------------------

    def setpoint(self, t: int, contact: ContactMeasurement, rate: float) -> Setpoint:
        """Return the set-point at `t` [ns]; a free motion advances by `rate` samples a period."""
        if self.segment.free is not None:
            return self._free_setpoint(t, contact, rate)
        regulation, point, speed, dt = self.regulation, self.point, self.along.velocity, self.period_s
        outward = self.wall.outward(point.p_W, t)
        rising = (self.wall.outward(point.p_W + point.dp_ds * speed * dt, t + round(dt * SECOND)) - outward) / dt
        distance = self._radius + outward - regulation.command_m
        before, step = contact.q if self.posture is None else self.posture, MOTION.posture_radps * dt
        self.posture = np.clip(point.q, before - step, before + step)
        point, sinking = point._replace(q=self.posture), regulation.rate - rising
        return stroke_setpoint(t, point, speed, distance, sinking, regulation.feed_forward_n)

    def _free_setpoint(self, t: int, contact: ContactMeasurement, rate: float) -> Setpoint:
        """Return a free motion that starts where the arm is and fades to the planned one: s(x) = 1 - x^2 (3 - 2 x) of the gap.

        It was planned from the wall as estimated before the touches. A centimetre off, the elbow of a stretched arm is 0.1 rad
        from there, and a step of the set-point would drive it faster than its limit.
        """
        free = self.segment.free
        assert free is not None
        last = len(free) - 1
        q, qd = free.at(self._sample)
        if self._q_offset is None:
            self._q_offset = contact.q - free.q[0]
        x = self._sample / last if last else 1.0
        share, fading = 1 - x * x * (3 - 2 * x), -6 * x * (1 - x) / (max(last, 1) * self.period_s)
        q_now, qd_now = q + share * self._q_offset, rate * (qd + fading * self._q_offset)
        X_WI = tool_pose(q_now, self._robot)
        self._behind, self.posture = is_behind(q_now, X_WI, contact), q_now
        return joint_setpoint(t, X_WI, q_now, qd_now, self._arm.stiffness_nmprad)
