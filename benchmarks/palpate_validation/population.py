"""Check of the sampler of persons: the statistics of their forces against those of the living people of Remus et al."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from scipy import stats

from palpate_models.numerics.frames import Array, Mask
from palpate_models.numerics.seeds import generator
from palpate_models.patient import remus2024
from palpate_models.patient.healthy import belly, healthy_wall, pressed_force
from palpate_models.patient.person import draw_person
from palpate_models.patient.schema import Build, Phantom
from palpate_validation.check import COLOURS, INK, Check, PageSection


class PopulationSetup(NamedTuple):
    """The sampled population."""

    persons: int = 200
    places: int = 5
    apart_m: float = 0.04
    """Minimum distance between positions on a person."""


SETUP = PopulationSetup()

LEFT_OUT = "force at 10 mm of a person left out: places in the 80 % interval of the other nine"
DEPTHS_M = [0.005, 0.010, 0.020]
AT_10_MM = 0.010


def figures(sample: pd.DataFrame) -> dict[str, float]:
    """Return the compared statistics of a sample: a row per place, with `person` and the force at each of `DEPTHS_M` [N]."""
    logs: pd.DataFrame = sample[DEPTHS_M].apply(np.log)
    ten = logs[AT_10_MM].groupby(sample["person"])
    exponents = logs.diff(axis=1) / np.log(2)
    scatter = float(((logs[AT_10_MM] - ten.transform("mean")) ** 2).sum())
    return {
        **{f"median force at {1e3 * depth:g} mm [N]": float(sample[depth].median()) for depth in DEPTHS_M},
        "5 % of forces at 10 mm are below [N]": float(sample[AT_10_MM].quantile(0.05)),
        "95 % are below [N]": float(sample[AT_10_MM].quantile(0.95)),
        "between people: deviation of the mean ln F at 10 mm": float(ten.mean().std()),
        "between places of one person: deviation of ln F at 10 mm": float(np.sqrt(scatter / (len(sample) - len(ten)))),
        "largest over smallest force at 10 mm on one person, median": float(_ratios(sample).median()),
        "median exponent, 5 to 10 mm": float(exponents[DEPTHS_M[1]].median()),
        "median exponent, 10 to 20 mm": float(exponents[DEPTHS_M[2]].median()),
        "deviation of the exponent, 10 to 20 mm": float(exponents[DEPTHS_M[2]].std()),
    }


WITHIN = (0.08, 0.08, 0.10, 0.15, 0.15, 0.40, 0.20, 0.12, 0.07, 0.07, 0.40)
"""Relative tolerance of each figure: the uncertainty of a sample of ten people."""


def sample_of(person: Sequence[int], force: Array) -> pd.DataFrame:
    """Return a sample of the numbers of persons, shape (n,), and forces [N], shape (n, 3)."""
    return pd.DataFrame(force, columns=DEPTHS_M).assign(person=person)


def read_measured() -> pd.DataFrame:
    """Return the 48 relaxed positions of the file."""
    places = remus2024.relaxed_people()
    force = np.array([remus2024.curve(*place).force(np.array(DEPTHS_M)) for place in places])
    return sample_of([remus2024.PEOPLE.index(person) for _, person in places], force)


def sample_persons(persons: int = SETUP.persons) -> pd.DataFrame:
    """Return persons of the seeds 0, 1, 2 .., each pressed at `SETUP.places` random positions of the belly away from bone.

    The force is that of a flat wall with the stiffness and stiffening of the place, quasi-static and axisymmetric
    (`palpate_models.patient.healthy.pressed_force`, which is within 3 % of the file at nearly all of its fitted places); the zero
    offset is the fits' median.
    """
    offset = float(np.median([fit.zero_offset_m for fit in remus2024.fitted().values()]))
    force = []
    for seed in range(persons):
        phantom = draw_person(Phantom(kind="person", build=Build.MEDIAN), seed)
        assert phantom.anatomy is not None
        usual = phantom.stiffness
        at = _places(belly(phantom.size_m, phantom.anatomy), generator(seed, "places"))
        wall = healthy_wall(at, phantom.size_m, phantom.anatomy, usual.stiffening_per_m, seed)
        for factor, stiffening in zip(wall.stiffness.tolist(), wall.stiffening.tolist(), strict=True):
            here = usual.model_copy(update={"k_w_n_per_m3": usual.k_w_n_per_m3 * factor, "stiffening_per_m": stiffening})
            force.append([pressed_force(here, 0.0, depth + offset) for depth in DEPTHS_M])
    return sample_of(np.repeat(np.arange(persons), SETUP.places).tolist(), np.array(force))


def inside_interval(people: pd.DataFrame) -> Mask:
    """Return for each position whether it is in the 80 % interval that the other people predict for a new person, shape (n,).

    ln F is normal between people and between positions of one person; the interval is Student's, for the mean of a few people.
    """
    logs = [np.log(own.to_numpy()) for _, own in people.groupby("person")[AT_10_MM]]
    inside = []
    for one, own in enumerate(logs):
        others = [each for number, each in enumerate(logs) if number != one]
        means = np.array([each.mean() for each in others])
        within = sum(((each - each.mean()) ** 2).sum() for each in others) / sum(len(each) - 1 for each in others)
        sd = np.sqrt(means.var(ddof=1) * (1 + 1 / len(means)) + within * (1 - 1 / np.mean([len(each) for each in others])))
        inside.append(np.abs(own - means.mean()) < stats.t.ppf(0.9, len(means) - 1) * sd)
    return np.concatenate(inside)


def _places(points: Array, rng: np.random.Generator) -> Array:
    """Return randomly chosen points of (m, 3), at least `SETUP.apart_m` from each other, shape (SETUP.places, 3)."""
    chosen: list[Array] = []
    for point in rng.permutation(points):
        if all(np.linalg.norm(point - other) >= SETUP.apart_m for other in chosen):
            chosen.append(point)
        if len(chosen) == SETUP.places:
            return np.array(chosen)
    raise RuntimeError(f"population: fewer than {SETUP.places} places {SETUP.apart_m} m apart among {len(points)}")


def section(found: pd.DataFrame | None = None) -> PageSection:
    """Return the comparison with its bounds."""
    found, people = sample_persons() if found is None else found, read_measured()
    checks = tuple(
        Check(name, ours, "", round(theirs * (1 - within), 3), round(theirs * (1 + within), 3), f"measured: {theirs:.3g}")
        for (name, ours), theirs, within in zip(figures(found).items(), figures(people).values(), WITHIN, strict=True)
    )
    covered = float(inside_interval(people).mean())
    checks += (Check(LEFT_OUT, covered, "of all", against=f"{len(people)} places of {people['person'].nunique()} people"),)
    text = (
        "This is a check of the sampler, whose moments come from the same ten people, and no validation of other persons. "
        f"{found['person'].nunique()} persons of `phantom.kind: person, build: median`, each pressed at {SETUP.places} random "
        "places of the belly away from bone by a sphere of 10 mm at 5 mm/s, against the 48 places of ten relaxed people (Remus "
        "et al. 2024, CC BY 4.0). Level, stiffening, length and their variation are drawn with the moments of `fitted.csv`. "
        "Ten people determine an SD between people with a standard error of a quarter; its bound is 40 %. The people were young, "
        "male and slim; other builds are not validated."
    )
    return PageSection("population", "Check of the person sampler", text, checks, lambda f: draw(f, found, people), (7.0, 2.8))


def draw(figure: Figure, found: pd.DataFrame, people: pd.DataFrame) -> None:
    """Draw distributions of force, of its ratio within a person and of its exponent, sampled and measured."""
    axes = figure.subplots(1, 3)
    shown = (
        ("force at 10 mm [N]", found[AT_10_MM], people[AT_10_MM]),
        ("largest over smallest on one person", _ratios(found), _ratios(people)),
        ("exponent, 10 to 20 mm", np.log2(found[0.020] / found[0.010]), np.log2(people[0.020] / people[0.010])),
    )
    for ax, (name, ours, theirs) in zip(axes, shown, strict=True):
        for values, colour, label, style in ((ours, COLOURS[0], "sampled", "-"), (theirs, INK, "measured", ".")):
            at = np.sort(np.asarray(values))
            ax.plot(at, (np.arange(len(at)) + 0.5) / len(at), style, ms=3, lw=1.2, color=colour, label=label)
        ax.set(xlabel=name, ylim=(0, 1))
    axes[0].set(ylabel="share below")
    axes[0].legend()


def _ratios(sample: pd.DataFrame) -> pd.Series:
    of_one = sample.groupby("person")[AT_10_MM]
    return of_one.max() / of_one.min()
