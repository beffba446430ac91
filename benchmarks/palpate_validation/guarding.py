"""Validation of guarding: its effect on the force of the standard press and of the strokes of an examination."""

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure

from palpate_models.numerics.frames import Array
from palpate_models.patient.healthy import tension_of_ratio
from palpate_models.patient.phantom import flat_phantom
from palpate_models.patient.schema import Stiffness
from palpate_models.patient.wall import FADING_S, MEDIAN, Guarding
from palpate_models.scenario import press
from palpate_tissue.backends.winkler.tissue import WinklerTissue
from palpate_validation.check import COLOURS, INK, QUIET, Check, PageSection

WALL = Stiffness(**MEDIAN._asdict(), friction=0.0)
RATIO: float = Guarding(centre_m=(0.0, 0.0)).ratio
KINDS = ("relaxed", "voluntary", "involuntary")


class GuardingSetup(NamedTuple):
    """The strokes over a guarding wall."""

    radius_m: float = 0.015
    step_s: float = 1e-3
    half_way_m: float = 0.05
    """Half length of a stroke, which slides back and forth."""
    strokes: int = 4
    apart_s: float = 1.0
    """Time between strokes, without contact. Guarding does not change during it."""


SETUP = GuardingSetup()

TOUCH_MPS, SLIDE_MPS = 0.014, 0.030
"""Speeds of touch and slide in an examination."""
BY_HAND = (0.25 + 0.75 * math.exp(-press.DEPTH_M / press.SPEED_MPS / FADING_S)) * math.exp(
    -(press.HOLD_S - press.READ_S / 2) / FADING_S
)
"""Contraction of voluntary guarding at the reading of the press: 20 mm/s cause a quarter of it, a hold at 10 mm none."""


class GuardedTouch(NamedTuple):
    """Forces of one wall on a path of the sphere; n instants."""

    time: Array
    """[s], shape (n,)."""
    force: Array
    """[N], shape (n,)."""
    contracted: Array
    """Contraction of the muscle [1], shape (n,)."""


class GuardingFelt(NamedTuple):
    """The standard press and the strokes on the three walls of `KINDS`."""

    presses: dict[str, GuardedTouch]
    strokes: dict[str, GuardedTouch]
    sliding: Array
    """Number of the stroke while the sphere slides at depth, -1 otherwise, shape (n,)."""

    def pressed_ratio(self, kind: str) -> float:
        """Return the force of the press divided by that of the relaxed wall."""
        read, _ = press.apparent_stiffness(np.stack([self.presses[which].force for which in (kind, "relaxed")]))
        return float(read[0] / read[1])

    def slid_ratio(self, kind: str, stroke: int) -> float:
        """Return the mean force of a stroke, relative to the same stroke on the relaxed wall."""
        at = self.sliding == stroke
        return float(self.strokes[kind].force[at].mean() / self.strokes["relaxed"].force[at].mean())


def wall(kind: str) -> WinklerTissue:
    """Return a flat wall of the median person, all of it muscle with this kind of guarding."""
    model = flat_phantom(0.09, 0.005, WALL.k_w_n_per_m3)
    each = np.ones(len(model.vertices))
    tension = 0.0 if kind == "relaxed" else tension_of_ratio(RATIO, WALL)
    return WinklerTissue(
        replace(model, stiffening=WALL.stiffening_per_m * each, tension=tension * each, voluntary=kind == "voluntary"), WALL
    )


def touch(kind: str, x: Array, depth: Array) -> GuardedTouch:
    """Move the sphere along the wall to the next `x` [m] and `depth` [m] per millisecond; negative depth is above the skin."""
    tissue = wall(kind)
    force, contracted = np.zeros(len(x)), np.zeros(len(x))
    before = np.array((x[0], 0.0, SETUP.radius_m))
    for k in range(len(x)):
        p = np.array((x[k], 0.0, SETUP.radius_m - depth[k]))
        force[k] = tissue.step(0.0, p, (p - before) / SETUP.step_s, SETUP.radius_m)[0][2]
        contracted[k], before = tissue.activation, p
    return GuardedTouch(SETUP.step_s * np.arange(1.0, len(x) + 1), force, contracted)


def strokes() -> tuple[Array, Array, Array]:
    """Return strokes of an examination: x [m], depth [m], and number of the stroke while it slides, -1 otherwise; (n,)."""
    down = np.arange(0.0, press.DEPTH_M, TOUCH_MPS * SETUP.step_s)
    corners = SETUP.half_way_m * np.array((-1.0, 1.0, -1.0))
    ends = np.concatenate(([0.0], np.cumsum(np.abs(np.diff(corners)))))
    along = np.interp(np.arange(0.0, ends[-1], SLIDE_MPS * SETUP.step_s), ends, corners)
    apart = np.full(round(SETUP.apart_s / SETUP.step_s), -0.01)
    x = np.concatenate((np.full(len(down), corners[0]), along, np.full(len(apart), corners[-1])))
    depth = np.concatenate((down, np.full(len(along), press.DEPTH_M), apart))
    sliding = np.concatenate((np.zeros(len(down)), np.ones(len(along)), np.zeros(len(apart))))
    number = np.repeat(np.arange(SETUP.strokes), len(x))
    return np.tile(x, SETUP.strokes), np.tile(depth, SETUP.strokes), np.where(np.tile(sliding, SETUP.strokes) > 0, number, -1)


def measure() -> GuardingFelt:
    """Run presses and strokes on each kind of wall."""
    depth = press.depths(press.times(SETUP.step_s))
    x, below, sliding = strokes()
    return GuardingFelt(
        {kind: touch(kind, np.zeros(len(depth)), depth) for kind in KINDS},
        {kind: touch(kind, x, below) for kind in KINDS},
        sliding,
    )


def section(found: GuardingFelt | None = None) -> PageSection:
    """Return the comparison of press and strokes under guarding, with bounds."""
    found = found or measure()
    read = found.presses["voluntary"].time > press.DURATION_S - press.READ_S
    level = float(found.presses["voluntary"].contracted[read].mean())
    voluntary, involuntary = (found.pressed_ratio(kind) for kind in ("voluntary", "involuntary"))
    first, last = (found.slid_ratio("voluntary", stroke) for stroke in (0, SETUP.strokes - 1))
    staying = found.slid_ratio("involuntary", SETUP.strokes - 1)
    left = float(found.strokes["voluntary"].contracted[found.sliding == SETUP.strokes - 1].mean())
    low, high = BY_HAND - 0.01, BY_HAND + 0.01
    checks = (
        Check("press, involuntary: over the relaxed wall", involuntary, "times", 2.0, 3.0, f"{RATIO:g} with the sphere of 10 mm"),
        Check("press, voluntary: over the relaxed wall", voluntary, "times", 1.5, involuntary, "between relaxed and involuntary"),
        Check("contraction of the muscle at the reading of the press", level, "", low, high, f"{BY_HAND:.3f}, by hand"),
        Check("stroke, involuntary: over the relaxed wall", staying, "times", 0.9 * involuntary, 1.15 * involuntary, "the press"),
        Check("first stroke, voluntary: over the relaxed wall", first, "times", 1.0, voluntary, "the press"),
        Check(f"stroke {SETUP.strokes}, voluntary: over the relaxed wall", last, "times", 1.0, first, "the first stroke"),
        Check("contraction of the muscle", left, "", None, 0.1, "relaxed"),
        Check("press over that stroke", voluntary / last, "times"),
    )
    text = (
        f"A flat wall of the median person, all of it muscle with a force ratio of {RATIO:g}, measured "
        "with the examination's indenter by the standard press, on a patient at rest, and by strokes of an examination (touch at "
        f"{1e3 * TOUCH_MPS:g} mm/s, {1e3 * press.DEPTH_M:g} mm deep, slide at {1e3 * SLIDE_MPS:g} mm/s, "
        f"{np.count_nonzero(found.sliding == 0) * SETUP.step_s:.1f} s each). Voluntary guarding relaxes by a quarter "
        "under the press, and completely under slow strokes, so strokes measure a smaller force than the press. "
        "Involuntary guarding has a slightly larger effect on strokes, since the wall relaxes under them and the muscle does "
        "not. The time constants of guarding are assumed."
    )
    return PageSection("guarding", "Guarding", text, checks, lambda f: draw(f, found), (7.0, 3.0))


def draw(figure: Figure, found: GuardingFelt) -> None:
    """Draw the force of the press over time, and the force of strokes relative to the relaxed wall, with the press's reading."""
    pressing, sliding = figure.subplots(1, 2, width_ratios=(1, 1.4))
    for kind, colour in zip(KINDS, (QUIET, COLOURS[1], COLOURS[0]), strict=True):
        pressing.plot(found.presses[kind].time, found.presses[kind].force, color=colour, label=kind)
        if kind == "relaxed":
            continue
        slid = np.where(found.sliding >= 0, found.strokes[kind].force, np.nan) / found.strokes["relaxed"].force.clip(1e-9)
        sliding.plot(found.strokes[kind].time, slid, color=colour, label=f"{kind}, strokes")
        sliding.axhline(found.pressed_ratio(kind), color=colour, lw=0.8, ls="--", label=f"{kind}, standard press")
    pressing.axvspan(press.DURATION_S - press.READ_S, press.DURATION_S, color=INK, alpha=0.08, lw=0)
    pressing.set(xlabel="time from the touch [s]", ylabel="force of the standard press [N]", ylim=(0, None))
    pressing.legend(loc="upper left")
    sliding.set(xlabel="time [s]", ylabel="force over the relaxed wall [1]", ylim=(0.9, None))
    sliding.legend(loc="center right")
