"""Validation of passivity: no closed cycle of pressing, sliding and lifting extracts work from the tissue."""

from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure

from palpate_models.numerics.frames import Array
from palpate_models.patient.phantom import PhantomModel, flat_phantom
from palpate_models.patient.schema import Lesion, Stiffness
from palpate_models.patient.wall import MEDIAN
from palpate_tissue.backends.winkler.tissue import WinklerTissue
from palpate_validation.check import COLOURS, INK, Check, PageSection


class CycleSetup(NamedTuple):
    """The random cycles."""

    radius_m: float = 0.015
    reach_m: float = 0.03
    """Sideways reach of a cycle."""
    deepest_m: float = 0.015
    cycles: int = 40


SETUP = CycleSetup()


class Cycle(NamedTuple):
    """Energies of one closed cycle [J]; arrays of shape (steps,)."""

    work: Array
    """Work done by the indenter on the tissue up to each step."""
    stored: Array
    """Energy stored in springs, branches and friction."""
    depth: Array
    """Depth of the sphere's lowest point below z = 0 [m]."""
    touched: int
    """Steps in contact."""

    @property
    def surplus(self) -> float:
        """Largest excess of stored energy over work done, relative to the largest stored energy; passive: not above 0."""
        return float((self.stored - self.work).max() / max(float(self.stored.max()), 1e-12))

    @property
    def gained(self) -> float:
        """Work extracted in the closed cycle, relative to the largest work done; passive: not above 0."""
        return float(-self.work[-1] / max(float(self.work.max()), 1e-12))


def lumpy_phantom() -> PhantomModel:
    """Return a flat wall that stiffens like the median person's, with the smallest and sharpest lesion of the mesh, x10."""
    model = flat_phantom(0.09, lesions=(Lesion(centre_m=(0.01, 0.0), radii_m=(0.015, 0.015), contrast=10, edge_m=0.002),))
    return replace(model, stiffening=np.full(len(model.vertices), MEDIAN.stiffening_per_m))


def closed_path(amplitude: Array, phase: Array, steps: int) -> Array:
    """Return a closed path of the sphere's centre [m], shape (steps + 1, 3), that starts and ends out of contact.

    `amplitude` and `phase` have shape (3, 3): harmonics 1 to 3 of x, y and depth, amplitudes from -1 to 1.
    """
    t = np.linspace(0, 2 * np.pi, steps + 1)
    waves = np.array([sum(a * np.sin((n + 1) * t + p) / (n + 1) for n, (a, p) in enumerate(zip(*row, strict=True)))
                      for row in zip(amplitude, phase, strict=True)])  # fmt: skip
    window = np.sin(t / 2) ** 2  # zero at both ends, where the sphere is 1 mm above the surface
    x, y = SETUP.reach_m / 2 * (waves[:2] - waves[:2, :1])
    dip = np.clip(0.6 + 0.4 * waves[2], -0.2, 1.0) * (SETUP.deepest_m + 0.001)
    return np.column_stack((x, y, SETUP.radius_m + 0.001 - window * dip))


def run_cycle(model: PhantomModel, path: Array, friction: float = 0.3) -> Cycle:
    """Move the sphere along a closed path, one step per millisecond; work by the trapezoidal rule."""
    tissue = WinklerTissue(model, Stiffness(friction=friction))
    work, stored, touched, done = [], [], 0, 0.0
    last = np.zeros(3)
    for k, (a, b) in enumerate(pairwise(path)):
        force, _ = tissue.step(k * tissue.dt, b, (b - a) / tissue.dt, SETUP.radius_m)
        done -= float(0.5 * (force + last) @ (b - a))
        work.append(done)
        stored.append(tissue.energy())
        touched += tissue.touching
        last = force
    return Cycle(np.array(work), np.array(stored), SETUP.radius_m - path[1:, 2], touched)


def measure(cycles: int = SETUP.cycles, seed: int = 0) -> list[Cycle]:
    """Run random closed cycles of 0.4 to 3 s, with and without friction."""
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
    """Return the cycles with their bounds."""
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
        f"{len(cycles)} random closed cycles that press a stiffening wall up to {SETUP.deepest_m * 1e3:g} mm, slide over a sharp "
        "lesion ten times as stiff, lift and return, with friction of 0, 0.3 or 1. At every millisecond the stored energy is at "
        f"most the work done, and every cycle dissipates {100 * min(lost):.0f} to {100 * max(lost):.0f} % of the work done."
    )
    return PageSection("energy", "Energy", text, checks, lambda f: draw(f, in_contact))


def draw(figure: Figure, cycles: list[Cycle]) -> None:
    """Draw work and stored energy of one cycle, and the dissipation of all cycles."""
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
