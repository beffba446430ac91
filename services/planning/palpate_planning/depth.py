"""Depth regulation on soft and stiff tissue, within a limit of force.

Depth d is measured: radius minus the signed distance of the sphere's centre (forward kinematics) from the estimated wall
at rest. The robot is an impedance K_z: commanded depth d_c yields d = d_c - (F - F_ff)/K_z. So

    F_ff = a LP(F)                          feed-forward of the measured force, a < 1: positive feedback of gain below one
    d_c  = d_r + k_i integral(d_r - d) - g  a slow integral for what is left: friction, model error
    d_r  -> min(target, d (F_max/F_p)^(1/n))   the depth at which the force would be F_max, if F ~ d^n
    g'   = w (F_p - F_max)/K_z, g >= 0      guard that needs no tissue model: a hard wall, a wrong exponent

with F the normal force, L the magnitude of the whole force (a hard edge pushes laterally, too), and F_p = L + tau dL/dt the
magnitude expected when the command takes effect.
"""

from typing import Final, NamedTuple


class DepthTuning(NamedTuple):
    """Constants of the law above."""

    exponent: float = 4.0
    """n: steeper than tissue (1.2 to 3), whose damping makes it steeper still for fast motion. With a flatter one the force
    swings about its limit at 5 to 10 Hz; a steeper one only approaches the limit later."""
    force_fraction: float = 0.83
    """Fraction of the working force limit at which depth yields: force rises until the arm has yielded."""
    feed_forward: float = 0.9
    """a, below one so that the force cannot build up by itself even on a rigid wall."""
    force_lag_s: float = 0.02
    """Low-pass of the measured force."""
    rate_lag_s: float = 0.03
    """Low-pass of its derivative."""
    lead_s: float = 0.04
    """tau: delay of the command (20 ms) and of the arm that follows it."""
    integral_per_s: float = 4.0
    """k_i: well below the impedance's bandwidth of about 5 Hz."""
    integral_max_m: float = 0.004
    """Limit of the integral, which acts only below an error of the same size: a larger one is a transient."""
    integral_fade_s: float = 0.1
    """Time constant with which the integral fades out of contact."""
    guard_per_s: float = 10.0
    """w: the depth of the guard follows the excess force over K_z."""
    guard_max_m: float = 0.02
    yield_lag_s: float = 0.03
    """Smoothing of d_r."""
    yield_mps: float = 0.08
    """Fastest d_r towards the wall."""
    return_mps: float = 0.02
    """Fastest d_r back into the tissue after yielding."""
    model_depth_m: float = 0.003
    """Below this depth the power law is replaced by the force at this depth."""
    rate_max_mps: float = 0.2
    """Maximum rate of the commanded depth that control may extrapolate by."""
    limited_m: float = 0.0002
    """Yielding by more than this is reported."""


DEPTH: Final = DepthTuning()


class Regulation(NamedTuple):
    """Output of the regulator at one step."""

    command_m: float
    """Depth to command."""
    rate: float
    """Rate of the commanded depth [m/s]."""
    reference_m: float
    """Depth aimed at: the target, or less where force limits it."""
    feed_forward_n: float
    """Normal feed-forward force, positive into the tissue."""
    limited: bool
    """True if depth yields to the force limit."""
    expected_force: float
    """F_p [N]."""


class DepthRegulator:
    """Regulates one stroke; one `update` per planning period, `reset` before the next stroke."""

    def __init__(self, period: float, stiffness: float, force_working: float, depth_max: float) -> None:
        """`stiffness` K_z [N/m] along the normal, `force_working` the working force limit [N].

        No deeper than `depth_max` [m] is commanded, unless the target itself is: where the wall is sought below its estimate.
        """
        self._dt, self._stiffness, self._depth_max = period, stiffness, depth_max
        self.force_max = DEPTH.force_fraction * force_working
        self.reset(0.0)

    def reset(self, depth: float) -> None:
        """Start at rest at a commanded depth [m], negative above the wall."""
        self._force = self._load = self._raw_load = self._slope = 0.0
        self._integral = self._guard = self._yield = 0.0
        self._command = depth

    def shift(self, change: float) -> None:
        """Move the zero of all depths: every depth reads `change` [m] more."""
        self._command += change

    def update(self, *, target_m: float, depth_m: float, normal_force_n: float, load_n: float, in_contact: bool) -> Regulation:
        """Advance one period.

        Args:
            target_m: target depth.
            depth_m: measured depth.
            normal_force_n: normal force.
            load_n: magnitude of the whole force.
            in_contact: True if the tissue is touched.
        """
        dt = self._dt
        self._slope += dt / (DEPTH.rate_lag_s + dt) * ((load_n - self._raw_load) / dt - self._slope)
        self._raw_load = load_n
        self._force += dt / (DEPTH.force_lag_s + dt) * (normal_force_n - self._force)
        self._load += dt / (DEPTH.force_lag_s + dt) * (load_n - self._load)
        expected = self._load + DEPTH.lead_s * max(self._slope, 0.0)

        self._guard += dt * DEPTH.guard_per_s * (expected - self.force_max) / self._stiffness
        self._guard = min(max(self._guard, 0.0), DEPTH.guard_max_m)
        allowed = target_m
        if expected > 0.5 * self.force_max:
            allowed = min(target_m, max(depth_m, DEPTH.model_depth_m) * (self.force_max / expected) ** (1.0 / DEPTH.exponent))
        step = (target_m - allowed - self._yield) * dt / (DEPTH.yield_lag_s + dt)
        self._yield = max(0.0, self._yield + min(max(step, -DEPTH.return_mps * dt), DEPTH.yield_mps * dt))
        reference = target_m - self._yield

        error = reference - depth_m
        if in_contact and abs(error) < DEPTH.integral_max_m:
            self._integral += dt * DEPTH.integral_per_s * error
            self._integral = min(max(self._integral, -DEPTH.integral_max_m), DEPTH.integral_max_m)
        elif not in_contact:
            self._integral -= dt / DEPTH.integral_fade_s * self._integral
        command = min(reference + self._integral - self._guard, max(target_m, self._depth_max))
        rate = (command - self._command) / dt
        self._command = command
        feed = DEPTH.feed_forward * min(max(self._force, 0.0), self.force_max)
        limited = self._yield + self._guard > DEPTH.limited_m
        return Regulation(command, min(max(rate, -DEPTH.rate_max_mps), DEPTH.rate_max_mps), reference, feed, limited, expected)
