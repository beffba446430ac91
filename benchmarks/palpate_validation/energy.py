"""Energy: no closed cycle of the indenter, pressing, sliding and lifting, gets work out of the tissue."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from matplotlib.figure import Figure

from palpate_models.numerics.frames import Array
from palpate_models.patient.phantom import PhantomModel, flat_phantom
from palpate_models.patient.schema import Lesion, Stiffness
from palpate_models.patient.wall import MEDIAN
from palpate_tissue.backends.winkler.tissue import WinklerTissue
from palpate_validation.check import Check, PageSection
from palpate_validation.plots import COLOURS, INK

RADIUS_M = 0.015
REACH_M = 0.03
"""Sideways reach of a cycle."""
DEEPEST_M = 0.015
CYCLES = 40


@dataclass(frozen=True)
class Cycle:
    """The books of one closed cycle, in joule; arrays of shape (steps,)."""

    work: Array
    """Done by the indenter on the tissue so far."""
    stored: Array
    """In springs, branches and friction."""
    depth: Array
    """Depth of the sphere's lowest point below z = 0 [m]."""
    touched: int
    """Steps in contact."""

    @property
    def surplus(self) -> float:
        """Largest excess of the stored energy over the work done, over the largest energy stored; passive: not above 0."""
        return float((self.stored - self.work).max() / max(float(self.stored.max()), 1e-12))

    @property
    def gained(self) -> float:
        """Work got out over the closed cycle, over the largest work put in; passive: not above 0."""
        return float(-self.work[-1] / max(float(self.work.max()), 1e-12))


def lumpy_phantom() -> PhantomModel:
    """A flat wall that stiffens as the median person's, and in it the smallest and sharpest lesion that the mesh allows, x10."""
    model = flat_phantom(0.09, lesions=(Lesion(centre_m=(0.01, 0.0), radii_m=(0.015, 0.015), contrast=10, edge_m=0.002),))
    return replace(model, stiffening=np.full(len(model.vertices), MEDIAN.stiffening_per_m))


def closed_path(amplitude: Array, phase: Array, steps: int) -> Array:
    """A closed path of the sphere's centre [m], shape (steps + 1, 3), that starts and ends out of contact.

    `amplitude` and `phase` have shape (3, 3): harmonics 1 to 3 of x, y and depth, amplitudes from -1 to 1.
    """
    t = np.linspace(0, 2 * np.pi, steps + 1)
    waves = np.array([sum(a * np.sin((n + 1) * t + p) / (n + 1) for n, (a, p) in enumerate(zip(*row, strict=True)))
                      for row in zip(amplitude, phase, strict=True)])  # fmt: skip
    window = np.sin(t / 2) ** 2  # zero at both ends, where the sphere is 1 mm above the surface
    x, y = REACH_M / 2 * (waves[:2] - waves[:2, :1])
    dip = np.clip(0.6 + 0.4 * waves[2], -0.2, 1.0) * (DEEPEST_M + 0.001)
    return np.column_stack((x, y, RADIUS_M + 0.001 - window * dip))


def run_cycle(model: PhantomModel, path: Array, friction: float = 0.3) -> Cycle:
    """Moves the sphere along a closed path, a step a millisecond; work by the trapezoidal rule."""
    tissue = WinklerTissue(model, Stiffness(friction=friction))
    work, stored, touched, done = [], [], 0, 0.0
    last = np.zeros(3)
    for k, (a, b) in enumerate(pairwise(path)):
        force, _ = tissue.step(k * tissue.dt, b, (b - a) / tissue.dt, RADIUS_M)
        done -= float(0.5 * (force + last) @ (b - a))
        work.append(done)
        stored.append(tissue.energy())
        touched += tissue.touching
        last = force
    return Cycle(np.array(work), np.array(stored), RADIUS_M - path[1:, 2], touched)


def measure(cycles: int = CYCLES, seed: int = 0) -> list[Cycle]:
    """Random closed cycles of 0.4 to 3 s, with and without friction."""
    rng = np.random.default_rng(seed)
    model = lumpy_phantom()
    return [
        run_cycle(
            model,
            closed_path(rng.uniform(-1, 1, (3, 3)), rng.uniform(0, 2 * np.pi, (3, 3)), int(rng.integers(400, 3000))),
            float(rng.choice((0.0, 0.3, 1.0))),
        )
        for _ in range(cycles)
    ]


def section(cycles: list[Cycle] | None = None) -> PageSection:
    """The cycles with their bounds."""
    cycles = cycles or measure()
    in_contact = [cycle for cycle in cycles if cycle.touched > 50]
    lost = [-cycle.gained for cycle in in_contact]
    checks = (
        Check("cycles with contact", len(in_contact), "", low=len(cycles) // 2),
        Check("largest work gained in a closed cycle, of the work put in", max(c.gained for c in in_contact), "", high=0.0,
              against="passivity"),
        Check("stored energy above the work done, of the largest stored", max(c.surplus for c in in_contact), "", high=1e-4,
              against="passivity"),
    )  # fmt: skip
    text = (
        f"{len(cycles)} random closed cycles that press a stiffening wall up to {DEEPEST_M * 1e3:g} mm, slide over a sharp "
        "lesion ten times as stiff, lift and come back, with friction of 0, 0.3 or 1. At no millisecond is more stored than was "
        f"put in, and every cycle costs work: {100 * min(lost):.0f} to {100 * max(lost):.0f} % of what was put in."
    )
    data = {"gained": [c.gained for c in in_contact], "surplus": [c.surplus for c in in_contact]}
    return PageSection("energy", "Energy", text, checks, lambda f: draw(f, in_contact), data=data)


def draw(figure: Figure, cycles: list[Cycle]) -> None:
    """Work and stored energy of one cycle, and what all cycles cost."""
    left, right = figure.subplots(1, 2)
    shown = max(cycles, key=lambda cycle: cycle.touched)
    t = np.arange(len(shown.work)) * 1e-3
    left.plot(t, 1e3 * shown.work, color=COLOURS[0], lw=1, label="work done by the indenter")
    left.plot(t, 1e3 * shown.stored, color=COLOURS[1], lw=1, label="stored")
    left.set(xlabel="time [s]", ylabel="energy [mJ]")
    left.legend()
    right.hist([-100 * cycle.gained for cycle in cycles], bins=20, range=(0, 100), color=COLOURS[0])
    right.axvline(0, color=INK, lw=0.8)
    right.set(xlabel="work lost in the cycle [% of the work put in]", ylabel="cycles")
