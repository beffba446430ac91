"""Validation of breathing: rate, shape and irregularity measured on the curve, and the mode over the body."""

from typing import NamedTuple

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from palpate_models.numerics.frames import Array
from palpate_models.patient.motion import TABLE_S, Breathing, BreathingCurve
from palpate_models.patient.phantom import PhantomModel, build_phantom
from palpate_models.patient.schema import Phantom
from palpate_validation.check import COLOURS, INK, Check, PageSection


class BreathingSetup(NamedTuple):
    """Sampling of the curves."""

    step_s: float = 0.01
    patients: int = 20
    shown_s: float = 60.0
    at_rest: float = 1e-4
    """Excursion, relative to the mean depth, below which the wall is at rest."""


SETUP = BreathingSetup()

KINDS = {
    "quiet": Breathing(kind="quiet"),
    "deep": Breathing(kind="deep"),
    "held": Breathing(kind="held"),
    "coughing": Breathing(kind="quiet", coughs_per_min=2),
}


def sample_excursion(breathing: Breathing, seed: int, until_s: float = TABLE_S) -> Array:
    """Return the excursion [m] of a patient at every `SETUP.step_s` [s]."""
    curve = BreathingCurve(breathing, seed)
    return np.array([curve.excursion(t) for t in np.arange(0, until_s, SETUP.step_s)])


def read(excursion: Array) -> pd.DataFrame:
    """Return the complete breaths in a curve, each from the start of a rise to the start of the next.

    Columns: duration of rise, fall and rest (inspiration, expiration, pause) and of all [s], depth [m], the rise's share.
    """
    above = excursion > SETUP.at_rest * excursion.mean()
    edges = np.diff(above.astype(int))
    rise, rest = np.flatnonzero(edges > 0), np.flatnonzero(edges < 0)
    rest = rest[rest > rise[0]][: len(rise) - 1]
    top = np.array([a + int(np.argmax(excursion[a : b + 1])) for a, b in zip(rise[:-1], rest, strict=True)])
    steps = {"inspiration": top - rise[:-1], "expiration": rest - top, "pause": rise[1:] - rest, "duration": np.diff(rise)}
    breaths = SETUP.step_s * pd.DataFrame(steps)
    return breaths.assign(depth=excursion[top], share=breaths["inspiration"] / breaths["duration"])


def section() -> PageSection:
    """Return the comparison of breathing curves of several patients with measurements on people, with bounds."""
    breaths = {
        kind: pd.concat([read(sample_excursion(KINDS[kind], seed)).assign(patient=seed) for seed in range(SETUP.patients)])
        for kind in ("quiet", "deep")
    }
    curves = {name: sample_excursion(breathing, 0, SETUP.shown_s) for name, breathing in KINDS.items()}
    speed = np.diff(curves["quiet"])
    jump = float(np.abs(np.diff(speed)).max() / np.abs(speed).max())
    body = build_phantom(Phantom(), 0)
    largest_at_m = float(np.hypot(*body.vertices[np.argmax(body.breathing), :2]))
    quiet, deep = breaths["quiet"].mean(), breaths["deep"].mean()
    of_one = breaths["quiet"].groupby("patient")
    variation = 100 * (of_one.std(ddof=0) / of_one.mean()).mean()
    memory = float(of_one["depth"].apply(lambda depth: np.corrcoef(depth[:-1], depth[1:])[0, 1]).mean())
    depth_mm, pause = 1e3 * quiet["depth"], 100 * float((breaths["quiet"]["pause"] / breaths["quiet"]["duration"]).mean())
    checks = (
        Check("breaths a minute, quiet", 60 / quiet["duration"], "", 13.5, 14.5, "14, n = 100 (Ragnarsdottir 2006)"),
        Check("breaths a minute, deep", 60 / deep["duration"], "", 7.1, 7.7, "7.4 (Ragnarsdottir 2006)"),
        Check("expiration over inspiration", quiet["expiration"] / quiet["inspiration"], "", 1.14, 1.26,
              "1.21 men, 1.14 women (Ragnarsdottir 2006)"),
        Check("pause, of a breath", pause, "%", against="assumed"),
        Check("depth at the navel, quiet", depth_mm, "mm", 5, 12, "5 to 12 mm, assumed"),
        Check("quiet over deep", quiet["depth"] / deep["depth"], "", None, 1 / 3, "less than a third, n = 100 (Kaneko 2012)"),
        Check("variation of duration from breath to breath", variation["duration"], "%", 18, 24, "20.8 % (Tobin 1988)"),
        Check("variation of depth from breath to breath", variation["depth"], "%", 28, 38, "33 % (Tobin 1988)"),
        Check("variation of inspiration's share of a breath", variation["share"], "%", 15, 21, "17.9 % (Tobin 1988)"),
        Check("correlation of depth with the breath before", memory, "", 0.15, 0.45, "0.30 (Tobin 1995)"),
        Check("change of speed in 10 ms, of the greatest", 100 * jump, "%", None, 5, "a curve without corners"),
        Check("share of the excursion at the body's border", float(body.breathing[body.fixed].max()), "", None, 0, "none"),
        Check("distance of the largest excursion from the navel", 1e3 * largest_at_m, "mm", None, 30, "the navel"),
    )  # fmt: skip
    text = (
        f"{len(of_one)} patients breathe for {TABLE_S:g} s each; their breaths are read from the curve, sampled at "
        f"{1 / SETUP.step_s:g} Hz, without access to the table of breaths. Duration and depth are log-normal and correlated "
        "from breath to breath; pause, depth in millimetres and coughs are assumed. Sighs are not modelled."
    )
    return PageSection("breathing", "Breathing", text, checks, lambda f: draw(f, curves, breaths["quiet"], body), (7.0, 5.0))


def draw(figure: Figure, curves: dict[str, Array], quiet: pd.DataFrame, body: PhantomModel) -> None:
    """Draw a minute of each kind, duration against depth of quiet breaths, and the mode over the body."""
    grid = figure.add_gridspec(2, 2, height_ratios=(1.5, 1))
    axes = figure.add_subplot(grid[0, :])
    for k, (name, curve) in enumerate(curves.items()):
        time = SETUP.step_s * np.arange(len(curve))
        axes.plot(time, 1e3 * curve + 30 * (len(curves) - 1 - k), color=COLOURS[k], lw=0.9, label=name)
    axes.set(xlabel="time [s]", ylabel="excursion [mm], 30 mm apart", ylim=(None, 135))
    axes.legend(ncols=4, loc="upper right")
    axes = figure.add_subplot(grid[1, 0])
    axes.plot(quiet["duration"], 1e3 * quiet["depth"], ".", color=COLOURS[0], ms=1.5)
    axes.set(xlabel="duration of a breath [s]", ylabel="depth [mm]")
    axes = figure.add_subplot(grid[1, 1])
    x, y, _ = body.vertices.T
    for at, other, name, colour in ((x, y, "across", COLOURS[1]), (y, x, "along", INK)):
        near = np.flatnonzero((np.abs(other) < 0.004) & (body.normals[:, 2] > 0))
        near = near[np.argsort(at[near])]
        axes.plot(1e3 * at[near], body.breathing[near], color=colour, lw=0.9, label=name)
    axes.set(xlabel="from the navel [mm]", ylabel="share of the excursion")
    axes.legend()
