"""Depth regulation: the sphere's true depth at its set-point, on soft and stiff tissue, within a limit of force.

Depth d is measured: radius minus the signed distance of the sphere's centre (forward kinematics) from the perceived rest
surface. The robot is an impedance K_z: commanded depth d_c yields d = d_c - (F - F_ff)/K_z. So

    F_ff = a LP(F)                          feed-forward of the measured force, a < 1: positive feedback of gain below one
    d_c  = d_r + k_i integral(d_r - d) - g  a slow integral for what is left: friction, model error
    d_r  -> min(target, d (F_max/F_p)^(1/1.45))   the depth at which the force would be F_max (F ~ d^1.45)
    g'   = w (F_p - F_max)/K_z, g >= 0      guard that needs no tissue model: a hard surface, a wrong exponent

with F the normal force, L the size of the whole force (sliding onto a hard edge pushes sideways, too), and F_p = L + tau dL/dt
the size that is expected when the command takes effect.
"""

from __future__ import annotations

from typing import NamedTuple

EXPONENT = 1.45
"""Local exponent of force against depth, 5 to 15 mm, of the tissue's foundation; Hertz has 1.5."""
FORCE_FRACTION = 0.83
"""Part of the working force limit at which depth yields: force rises until the arm has yielded, and the sensor's gain errs."""
FEED_FORWARD = 0.9
"""a, below one so that the force cannot build up by itself even on a rigid surface."""
FORCE_LAG_S = 0.02
"""Low-pass of the measured force."""
RATE_LAG_S = 0.03
"""Low-pass of its derivative."""
LEAD_S = 0.08
"""tau: delay of the command (20 ms) and rise of the impedance (about 60 ms)."""
INTEGRAL_PER_S = 4.0
"""k_i: well below the impedance's bandwidth of about 5 Hz."""
INTEGRAL_MAX_M = 0.004
INTEGRAL_FADE_S = 0.1
"""Out of contact the integral fades."""
GUARD_PER_S = 10.0
"""w, the rate of the guard [1/s]: its depth follows the excess force over K_z."""
GUARD_MAX_M = 0.02
YIELD_LAG_S = 0.03
"""Smoothing of d_r."""
YIELD_MPS = 0.08
"""Fastest d_r towards the surface."""
RETURN_MPS = 0.02
"""Fastest d_r back into the tissue after yielding."""
MODEL_DEPTH_M = 0.003
"""Shallower than this the power law is not trusted: the force is taken for that of this depth."""
RATE_MAX_MPS = 0.2
"""Greatest rate of the commanded depth that is passed on for control to extrapolate by."""
LIMITED_M = 0.0002
"""Yielding by more than this is reported."""


class Regulation(NamedTuple):
    """What the regulator asks for at one step."""

    depth: float
    """Depth to command [m]."""
    rate: float
    """Its rate [m/s]."""
    reference: float
    """The depth aimed at [m]: the target, or less where force limits it."""
    force: float
    """Normal feed-forward force [N], positive into the tissue."""
    limited: bool
    """Whether depth yields to the force limit."""
    expected_force: float
    """F_p [N]."""


class DepthRegulator:
    """Regulates one stroke; `reset` before the next. One call a planning period."""

    def __init__(self, period: float, stiffness: float, force_working: float, depth_max: float) -> None:
        """`stiffness` K_z [N/m] along the normal, `force_working` the working force limit [N].

        No deeper than `depth_max` [m] is commanded, unless the target itself is.
        """
        self._dt, self._stiffness, self._depth_max = period, stiffness, depth_max
        self.force_max = FORCE_FRACTION * force_working
        self.reset(0.0)

    def reset(self, depth: float) -> None:
        """Starts at rest at a commanded depth [m], negative above the surface."""
        self._force = self._load = self._raw_load = self._slope = 0.0
        self._integral = self._guard = self._yield = 0.0
        self._command = depth

    def shift(self, change: float) -> None:
        """Moves the zero of all depths: every depth reads `change` [m] more."""
        self._command += change

    def update(self, target: float, depth: float, force: float, load: float, in_contact: bool) -> Regulation:
        """One step: target and measured depth [m], normal force and size of the whole [N], whether the tissue is touched."""
        dt = self._dt
        self._slope += dt / (RATE_LAG_S + dt) * ((load - self._raw_load) / dt - self._slope)
        self._raw_load = load
        self._force += dt / (FORCE_LAG_S + dt) * (force - self._force)
        self._load += dt / (FORCE_LAG_S + dt) * (load - self._load)
        expected = self._load + LEAD_S * max(self._slope, 0.0)

        self._guard += dt * GUARD_PER_S * (expected - self.force_max) / self._stiffness
        self._guard = min(max(self._guard, 0.0), GUARD_MAX_M)
        allowed = target
        if expected > 0.5 * self.force_max:
            allowed = min(target, max(depth, MODEL_DEPTH_M) * (self.force_max / expected) ** (1.0 / EXPONENT))
        step = (target - allowed - self._yield) * dt / (YIELD_LAG_S + dt)
        self._yield = max(0.0, self._yield + min(max(step, -RETURN_MPS * dt), YIELD_MPS * dt))
        reference = target - self._yield

        error = reference - depth
        if in_contact and abs(error) < INTEGRAL_MAX_M:
            self._integral += dt * INTEGRAL_PER_S * error
            self._integral = min(max(self._integral, -INTEGRAL_MAX_M), INTEGRAL_MAX_M)
        elif not in_contact:
            self._integral -= dt / INTEGRAL_FADE_S * self._integral
        command = min(reference + self._integral - self._guard, max(target, self._depth_max))
        rate = (command - self._command) / dt
        self._command = command
        feed = FEED_FORWARD * min(max(self._force, 0.0), self.force_max)
        limited = self._yield + self._guard > LIMITED_M
        return Regulation(command, min(max(rate, -RATE_MAX_MPS), RATE_MAX_MPS), reference, feed, limited, expected)
