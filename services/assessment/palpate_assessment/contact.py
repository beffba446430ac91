"""Sphere on a Winkler-Pasternak foundation: force, footprint and memory at unit foundation modulus.

The wall resists a normal displacement u [m] with the pressure p = k_w (u - l^2 lap u) [Pa] (Kerr 1964, "Elastic and
viscoelastic foundation models"). Under a sphere of radius R pressed to depth d the displacement is prescribed,
w(r) = d - (R - sqrt(R^2 - r^2)), up to the contact radius a; outside it decays as K0(r / l). The obstacle problem's solution
is C^1, which gives a; force, footprint and overlap follow in closed form or by quadrature. Everything scales with k_w, so
that k_w = F / f(d).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter
from scipy.optimize import brentq
from scipy.signal import lfilter
from scipy.special import k0, k0e, k1, k1e

from palpate_models import press
from palpate_models.frames import Array
from palpate_models.patient import Stiffness

_PIXEL = 0.0005
"""Raster on which footprints and overlaps are integrated [m]; halving it changes them by less than 0.5 %."""
REACH = 0.048
"""Radius beyond which a footprint is cut [m]: it holds more than 99.5 % of it at 20 mm depth."""

_PRESS_STEP_S = 0.001
"""Step in which the relaxation under a press is summed [s]."""


@dataclass(frozen=True)
class StaticContact:
    """Elastic contact at one depth, per unit foundation modulus."""

    depth: float
    """Indentation d [m]."""
    sphere: float
    """Radius R of the sphere [m]."""
    length: float
    """Pasternak length l [m]."""
    radius: float
    """Contact radius a [m]."""
    force: float
    """F / k_w [m^3]."""

    @property
    def edge(self) -> float:
        """Displacement at the contact's edge, w(a) [m]."""
        return self.depth - self.sphere + float(np.sqrt(self.sphere**2 - self.radius**2))

    def influence(self, r: Array) -> Array:
        """du/dd at distance r [m] from the axis: 1 in contact, K0(r/l) / K0(a/l) outside [1]."""
        return np.asarray(
            np.where(r < self.radius, 1.0, k0(np.maximum(r, self.radius) / self.length) / k0(self.radius / self.length))
        )

    def pressure(self, r: Array) -> Array:
        """Contact pressure over k_w at distance r [m]: w - l^2 lap w in contact, else 0 [m]."""
        s = np.sqrt(self.sphere**2 - np.minimum(r, self.radius) ** 2)
        curvature = 2.0 / s + np.minimum(r, self.radius) ** 2 / s**3
        return np.asarray(np.where(r < self.radius, self.depth - self.sphere + s + self.length**2 * curvature, 0.0))

    def footprint(self, r: Array) -> Array:
        """Sensitivity of the force to the modulus at distance r [m], dF/dk_w per area [m]; integrates to `force`.

        The energy is U = 1/2 int k_w (u^2 + l^2 |grad u|^2), F = dU/dd, and by the envelope theorem a change of k_w at fixed u
        gives dF = int dk_w (u phi + l^2 grad u . grad phi), with phi the influence.
        """
        a, ell = self.radius, self.length
        outside = np.maximum(r, a)
        scale = k0(a / ell)
        phi, slope = k0(outside / ell) / scale, k1(outside / ell) / scale
        inside = self.depth - self.sphere + np.sqrt(self.sphere**2 - np.minimum(r, a) ** 2)
        return np.asarray(np.where(r < a, inside, self.edge * (phi**2 + slope**2)))


def static_contact(depth: float, sphere: float, length: float) -> StaticContact:
    """The elastic contact at `depth` of a sphere of radius `sphere` on a foundation of Pasternak length `length` [m].

    Raises ValueError unless 0 < depth <= 2 * sphere.
    """
    if not 0.0 < depth <= 2.0 * sphere:
        raise ValueError(f"depth = {depth} m: want more than 0 and at most the sphere's diameter, {2 * sphere} m")

    def kink(a: float) -> float:
        s = np.sqrt(sphere**2 - a**2)
        return float(-a / s + (depth - sphere + s) / length * k1e(a / length) / k0e(a / length))

    touch = sphere if depth >= sphere else float(np.sqrt(2 * sphere * depth - depth**2))
    a = float(brentq(kink, 1e-9, touch * (1 - 1e-9)))
    s = np.sqrt(sphere**2 - a**2)
    volume = np.pi * a**2 * (depth - sphere) + 2.0 * np.pi / 3.0 * (sphere**3 - s**3)
    return StaticContact(depth, sphere, length, a, float(volume + 2.0 * np.pi * length**2 * a * a / s))


class ReferenceContact:
    """Tables of the contact of one indenter with the nominal wall, at unit foundation modulus.

    The constants are the literature's for a healthy wall (`Stiffness` defaults): Pasternak length, Prony series, dashpot.
    """

    def __init__(self, sphere: float, common_depth: float, material: Stiffness | None = None) -> None:
        """For a sphere of radius `sphere` [m]; forces are compared at `common_depth` [m]."""
        self.material = material or Stiffness()
        self.sphere = sphere
        self.common_depth = common_depth
        deepest = min(0.03, 1.8 * sphere)
        self._depths = np.linspace(2e-4, deepest, 80)
        length = self.material.length_m
        self._force = np.array([static_contact(float(d), sphere, length).force for d in self._depths])
        wider = np.array([static_contact(float(d), 1.02 * sphere, length).force for d in self._depths])
        self._radius_exponent = np.log(wider / self._force) / np.log(1.02)
        self._log_depths, self._log_force = np.log(self._depths), np.log(self._force)
        self._exponent = np.gradient(self._log_force, self._log_depths)
        self._footprints: dict[tuple[int, float], Array] = {}
        self._overlap = self._overlap_table()

    def force(self, depth: Array, curvature: Array | float = 0.0) -> Array:
        """Instantaneous elastic force over k_w [m^3] at depths [m] on a surface of mean curvature [1/m], convex positive.

        To first order a convex surface acts as a smaller sphere, 1 / R_eff = 1 / R + curvature.
        """
        d = np.clip(depth, self._depths[0], self._depths[-1])
        flat = np.exp(np.interp(np.log(d), self._log_depths, self._log_force))
        exponent = np.interp(d, self._depths, self._radius_exponent)
        return np.asarray(flat * np.maximum(1.0 + self.sphere * np.asarray(curvature), 0.5) ** -exponent)

    def press_force(self, curvature: Array) -> Array:
        """What the standard press feels, over k_w [m^3], on a surface of mean curvature [1/m], shape (n,).

        The instantaneous force at its depth, less what the wall has relaxed on the way there and while it was held:
        1 - sum g_i / tau_i int exp(-(t - s) / tau_i) f(d(s)) / f(d) ds, the mean over the time in which it is read.
        """
        at = press.times(_PRESS_STEP_S)
        pressed = self.force(press.depths(at)) / self.force(np.array(press.DEPTH_M))
        lost = np.zeros_like(at)
        for g, tau in zip(self.material.prony_g, self.material.prony_tau_s, strict=True):
            decay = np.exp(-_PRESS_STEP_S / tau)
            lost += lfilter([g * (1 - decay)], [1, -decay], pressed)
        read = at > press.DURATION_S - press.READ_S
        return self.force(np.array(press.DEPTH_M), curvature) * float((pressed - lost)[read].mean())

    def exponent(self, depth: Array) -> Array:
        """Local exponent d log F / d log depth [1]."""
        return np.asarray(np.interp(depth, self._depths, self._exponent))

    def footprint(self, depth: float, pitch: float) -> tuple[Array, Array]:
        """Normalised footprint at a depth, averaged over cells of `pitch` [m]: distances [m] and weights [1/m^2]."""
        key = (round(float(np.clip(depth, 0.002, self._depths[-1])) * 1000), pitch)
        n = int(np.ceil(1.15 * REACH / _PIXEL))
        if key not in self._footprints:
            axis = np.arange(-n, n + 1) * _PIXEL
            r = np.hypot(*np.meshgrid(axis, axis))
            raster = static_contact(key[0] / 1000, self.sphere, self.material.length_m).footprint(r)
            raster = gaussian_filter(raster, pitch / np.sqrt(12.0) / _PIXEL)
            raster /= raster.sum() * _PIXEL**2
            self._footprints[key] = raster[n, n:].copy()
        return np.asarray(np.arange(n + 1) * _PIXEL), self._footprints[key]

    def overlap(self, distance: Array) -> Array:
        """Part of the pressure of an indentation that loads one at `distance` [m] beside it [1]; 1 at zero distance."""
        return np.asarray(np.interp(distance, np.arange(len(self._overlap)) * 0.002, self._overlap, right=0.0))

    def _overlap_table(self) -> Array:
        contact = static_contact(self.common_depth, self.sphere, self.material.length_m)
        n = int(np.ceil(contact.radius / _PIXEL))
        axis = np.arange(-n, n + 1) * _PIXEL
        x, y = np.meshgrid(axis, axis)
        p = contact.pressure(np.hypot(x, y))
        weights = [float((p * contact.influence(np.hypot(x + s, y))).sum() / p.sum()) for s in np.arange(0.0, 0.08, 0.002)]
        return np.array(weights) / weights[0]

    def advance(self, velocity: Array) -> Array:
        """How far the footprint runs ahead of a sliding sphere, shape as `velocity` [m/s] -> [m].

        The dashpot makes the stress that of u + tau du/dt, which is u moved ahead by tau v; unilateral contact takes a fifth
        of it (fitted on a transient solution of the sliding contact at 10-60 mm/s, see README).
        """
        return np.asarray(0.8 * self.material.dashpot_s * velocity)
