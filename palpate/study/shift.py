"""The split `shift`: patients and equipment from other sources, shapes and ranges than those that thresholds are chosen on.

Each patient is a drawn person with one thing changed, by family. The variants of a family come in turn; everything else is
drawn from the seed. docs/studies.md lists the ranges with their sources, with these marks: [V] read in the source, [A] assumed.
"""

from collections.abc import Callable, Mapping, Sequence
from enum import StrEnum
from typing import Any, Final

import numpy as np
from scipy.optimize import nnls
from scipy.special import exp1

from palpate_errors import UserError
from palpate_models.numerics.frames import Array
from palpate_models.numerics.seeds import generator
from palpate_models.patient.schema import Anatomy, Phantom, Skeleton, Structure, StructureKind
from palpate_models.scenario.schema import Scenario
from palpate_models.section import Vec2

Rng = np.random.Generator
Settings = dict[str, Any]
Span = tuple[float, float]


class Family(StrEnum):
    """Parts of patient and equipment that are changed."""

    RELAXATION = "relaxation"
    CONTACT = "contact"
    """Sliding speed and radius of the indenter."""
    BONES = "bones"
    STRUCTURES = "structures"
    VARIATION = "variation"
    EQUIPMENT = "equipment"


def shift_patient(scenario: Scenario, family: Family, number: int) -> Settings:
    """Return the changes, as fields by path, that make patient `number` of a family from a scenario with a drawn person.

    Raises UserError for a scenario of another kind.
    """
    if scenario.phantom.anatomy is None:
        raise UserError(f"phantom.kind = {scenario.phantom.kind}: the split shift changes persons; expected person")
    variants = list(FAMILIES[family].values())
    change = variants[number % len(variants)]
    return change(scenario.phantom, scenario.phantom.anatomy, generator(scenario.seed, f"shift {family}"))


def _log(rng: Rng, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _change(phantom: Phantom, **changes: Any) -> Settings:
    return {"phantom": phantom.model_copy(update=changes).model_dump(mode="json")}


# --- relaxation -----------------------------------------------------------------------------------------------------------

_TAU_S: Final = (0.1, 1.5, 20.0, 250.0)
"""Time constants that stand for a continuous spectrum: as many as the FMU has room for."""
_FITTED_S: Final = np.geomspace(0.01, 600.0, 120)


def _prony(relaxation: Array) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return the Prony series that is next to a relaxation function from 1, given at _FITTED_S."""
    branches = 1 - np.exp(-_FITTED_S[:, None] / np.array(_TAU_S))
    shares, _ = nnls(branches, 1 - relaxation)
    return tuple((shares * min(1.0, 0.95 / shares.sum())).tolist()), _TAU_S


def _relaxing(series: Callable[[Rng], tuple[tuple[float, ...], tuple[float, ...]]]) -> Callable[..., Settings]:
    def change(phantom: Phantom, _: Anatomy, rng: Rng) -> Settings:
        g, tau = series(rng)
        return _change(phantom, stiffness=phantom.stiffness.model_copy(update={"prony_g": g, "prony_tau_s": tau}))

    return change


def _power_law(rng: Rng) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """(1 + t / t0)^-alpha: a springpot from t0 on."""
    return _prony((1 + _FITTED_S / _log(rng, 0.02, 0.2)) ** -rng.uniform(0.05, 0.20))


def _box_spectrum(rng: Rng) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Fung's quasi-linear relaxation, (1 + c (E1(t / t2) - E1(t / t1))) / (1 + c ln(t2 / t1))."""
    c, short, long = rng.uniform(0.05, 0.3), _log(rng, 0.05, 1.0), _log(rng, 60.0, 400.0)
    return _prony((1 + c * (exp1(_FITTED_S / long) - exp1(_FITTED_S / short))) / (1 + c * np.log(long / short)))


def _branches(shares: Sequence[Span], times_s: Sequence[Span]) -> Callable[..., Settings]:
    """A Prony series with shares and time constants [s] from these ranges."""
    return _relaxing(
        lambda rng: (tuple(float(rng.uniform(*span)) for span in shares), tuple(_log(rng, *span) for span in times_s))
    )


# --- speed and radius -----------------------------------------------------------------------------------------------------


def _contact(speed_mps: Span | None, radius_m: Span | None) -> Callable[..., Settings]:
    def change(_: Phantom, __: Anatomy, rng: Rng) -> Settings:
        ranges = {"exam.speed_mps": speed_mps, "robot.indenter_radius_m": radius_m}
        return {name: _log(rng, *limits) for name, limits in ranges.items() if limits is not None}

    return change


# --- bones ----------------------------------------------------------------------------------------------------------------

_USUAL: Final = Skeleton(costal_arch_m=0.18, costal_slope=0.7, iliac_crest_m=(0.135, -0.12))
"""Means of the drawn skeletons of a body of 0.46 m; displacements are from there."""
_DISPLACED_M: Final = (0.020, 0.045)


def _skeletal(change: Callable[[Skeleton, float, Rng], Mapping[str, Any]]) -> Callable[..., Settings]:
    def apply(phantom: Phantom, anatomy: Anatomy, rng: Rng) -> Settings:
        scale = phantom.size_m[1] / 0.46
        x, y = _USUAL.iliac_crest_m
        usual = _USUAL.model_copy(update={"costal_arch_m": scale * _USUAL.costal_arch_m, "iliac_crest_m": (scale * x, scale * y)})
        skeleton = usual.model_copy(update=change(usual, float(rng.uniform(*_DISPLACED_M)), rng))
        return _change(phantom, anatomy=anatomy.model_copy(update={"skeleton": skeleton}))

    return apply


def _ribs_nearer(usual: Skeleton, by: float, _: Rng) -> Mapping[str, Any]:
    return {"costal_arch_m": usual.costal_arch_m - by}


def _spines_nearer(usual: Skeleton, by: float, _: Rng) -> Mapping[str, Any]:
    nearer = np.array(usual.iliac_crest_m) * (1 - by / np.hypot(*usual.iliac_crest_m))
    return {"iliac_crest_m": tuple(nearer.tolist())}


def _navel_moved(usual: Skeleton, by: float, rng: Rng) -> Mapping[str, Any]:
    up = by * rng.choice((-1.0, 1.0))
    x, y = usual.iliac_crest_m
    return {"costal_arch_m": usual.costal_arch_m - up, "iliac_crest_m": (x, y - up)}


def _narrow(usual: Skeleton, by: float, rng: Rng) -> Mapping[str, Any]:
    x, y = usual.iliac_crest_m
    return {"costal_slope": float(rng.uniform(1.0, 1.4)), "iliac_crest_m": (x - by, y)}


def _wide(usual: Skeleton, by: float, rng: Rng) -> Mapping[str, Any]:
    x, y = usual.iliac_crest_m
    slope, arch = float(rng.uniform(0.25, 0.40)), usual.costal_arch_m - max(by, 0.035)
    return {"costal_slope": slope, "costal_arch_m": arch, "iliac_crest_m": (x + by, y)}


def _asymmetric(usual: Skeleton, by: float, rng: Rng) -> Mapping[str, Any]:
    """The spines are higher and lower by up to `by`, and the midline is to the side of the navel."""
    sides = rng.choice((-1.0, 1.0), 2)
    return {"tilt": float(sides[0] * by / usual.iliac_crest_m[0]), "lateral_m": float(sides[1] * rng.uniform(0.005, 0.020))}


# --- structures -----------------------------------------------------------------------------------------------------------


def _with(make: Callable[[Skeleton, Rng], list[Structure]]) -> Callable[..., Settings]:
    def change(phantom: Phantom, anatomy: Anatomy, rng: Rng) -> Settings:
        return _change(phantom, structures=tuple(make(anatomy.skeleton, rng)))

    return change


def _scar(line: Array, rng: Rng) -> list[Structure]:
    """Return a scar along points (k, 2) [m], that wavers by some millimetres."""
    wavy = line + rng.normal(0.0, 0.002, line.shape)
    half = float(rng.uniform(0.003, 0.007))
    points: tuple[Vec2, ...] = tuple((x, y) for x, y in wavy.tolist())
    return [Structure(kind=StructureKind.SCAR, line_m=points, radii_m=(half, half), factor=_log(rng, 1.6, 5.0))]


def _straight(centre: Array, angle: float, length: float, points: int = 5) -> Array:
    """Return points along a line, shape (k, 2)."""
    along = np.linspace(-0.5, 0.5, points) * length
    return np.asarray(centre + along[:, None] * np.array((np.cos(angle), np.sin(angle))))


def _mcburney(skeleton: Skeleton, rng: Rng) -> list[Structure]:
    """Across the line from the right iliac spine to the navel, at a third of it from the spine."""
    spine = np.array((-1.0, 1.0)) * skeleton.iliac_crest_m
    centre = spine * 2 / 3 + rng.normal(0.0, 0.006, 2)
    angle = np.arctan2(*spine[::-1]) + np.pi / 2 + rng.normal(0.0, 0.25)
    return _scar(_straight(centre, angle, rng.uniform(0.04, 0.09)), rng)


def _midline(skeleton: Skeleton, rng: Rng) -> list[Structure]:
    """From below the costal arch downwards, around the navel on its left."""
    y = np.linspace(rng.uniform(0.06, skeleton.costal_arch_m - 0.02), -rng.uniform(0.04, 0.13), 9)
    x = rng.uniform(0.012, 0.020) * np.exp(-((y / 0.02) ** 2))
    return _scar(np.column_stack((x, y)), rng)


def _subcostal(skeleton: Skeleton, rng: Rng) -> list[Structure]:
    """Parallel to the right costal margin and below it."""
    x = -np.linspace(0.015, rng.uniform(0.09, 0.13), 6)
    y = skeleton.costal_arch_m - skeleton.costal_slope * np.abs(x) - rng.uniform(0.02, 0.05)
    return _scar(np.column_stack((x, y)), rng)


def _ports(_: Skeleton, rng: Rng) -> list[Structure]:
    """Three or four trocars of 5 to 12 mm."""
    places = np.array(((0.0, 0.018), (0.0, 0.085), (-0.075, 0.045), (-0.085, -0.02), (0.07, -0.03)))
    chosen = rng.permutation(places)[: rng.integers(3, 5)]
    return [one for at in chosen for one in _scar(_straight(at, rng.uniform(0, np.pi), rng.uniform(0.005, 0.014), 2), rng)]


def _hernia(_: Skeleton, rng: Rng) -> list[Structure]:
    across, ratio = rng.uniform(0.010, 0.040) / 2, rng.uniform(0.8, 1.25)
    centre = (float(rng.normal(0.0, 0.003)), float(rng.uniform(-0.010, 0.030)))
    radii = (across * ratio, across / ratio)
    return [Structure(kind=StructureKind.HERNIA, line_m=(centre,), radii_m=radii, factor=_log(rng, 0.25, 0.6))]


def _diastasis(skeleton: Skeleton, rng: Rng) -> list[Structure]:
    top, bottom = rng.uniform(0.08, skeleton.costal_arch_m - 0.02), -rng.uniform(0.0, 0.05)
    half = float(rng.uniform(0.025, 0.060)) / 2
    line = ((0.0, float(top)), (0.0, float(bottom)))
    factor = _log(rng, 0.35, 0.75)
    return [Structure(kind=StructureKind.DIASTASIS, line_m=line, radii_m=(half, half), factor=factor, edge_m=0.010)]


def _mesh(_: Skeleton, rng: Rng) -> list[Structure]:
    centre = (float(rng.normal(0.0, 0.008)), float(rng.uniform(-0.02, 0.04)))
    radii = tuple(rng.uniform(0.030, 0.075, 2).tolist())
    return [Structure(kind=StructureKind.MESH, line_m=(centre,), radii_m=radii, factor=_log(rng, 1.3, 3.0), edge_m=0.010)]


def _stool(_: Skeleton, rng: Rng) -> list[Structure]:
    """Loaded descending and sigmoid colon, on the left and then towards the pelvis, or a single lump of stool in it."""
    colon = np.array(((0.105, 0.03), (0.105, -0.03), (0.085, -0.065), (0.050, -0.085), (0.015, -0.095)))
    first = int(rng.integers(len(colon) - 1))
    part = colon[first : first + int(rng.integers(2, 5))] + rng.normal(0.0, 0.006, 2)
    points: tuple[Vec2, ...] = tuple((x, y) for x, y in part.tolist())
    half, depth = float(rng.uniform(0.015, 0.030)), float(rng.uniform(0.008, 0.025))
    factor = _log(rng, 1.8, 6.0)
    return [Structure(kind=StructureKind.STOOL, line_m=points, radii_m=(half, half), factor=factor, depth_m=depth)]


def _pulse(phantom: Phantom, _: Anatomy, rng: Rng) -> Settings:
    beats = {"pulse_m": float(rng.uniform(0.0003, 0.0015)), "pulse_per_min": float(rng.uniform(55, 95))}
    return _change(phantom, breathing=phantom.breathing.model_copy(update=beats))


# --- variation of the wall ------------------------------------------------------------------------------------------------


def _varying(correlation_m: Span, natural_m: Span) -> Callable[..., Settings]:
    """A Gaussian field that replaces most of the drawn one, of other lengths."""

    def change(phantom: Phantom, anatomy: Anatomy, rng: Rng) -> Settings:
        given = anatomy.variation
        variation = given.model_copy(update={"stiffness": 0.4 * given.stiffness, "length_m": natural_m})
        field = {"cv": float(rng.uniform(0.12, 0.30)), "correlation_m": _log(rng, *correlation_m)}
        background = phantom.background.model_copy(update=field)
        return _change(phantom, background=background, anatomy=anatomy.model_copy(update={"variation": variation}))

    return change


# --- equipment ------------------------------------------------------------------------------------------------------------

_GAIN: Final = 0.08
_ASKEW_RAD: Final = float(np.radians(3.0))
_LEVER_M: Final = 0.15
"""From the flange to the indenter, about."""


def _error_change(**values: Any) -> Callable[..., Settings]:
    def change(_: Phantom, __: Anatomy, ___: Rng) -> Settings:
        return {f"errors.chosen.{name}": value for name, value in values.items()}

    return change


def _askew(_: Phantom, __: Anatomy, rng: Rng) -> Settings:
    """A tool that leans to a random side: the sensor's axes turn, and the indenter is to the side of the flange's axis."""
    turn = rng.uniform(0, 2 * np.pi)
    about_x, about_y = float(_ASKEW_RAD * np.cos(turn)), float(_ASKEW_RAD * np.sin(turn))
    aside = [_LEVER_M * about_y, -_LEVER_M * about_x]
    return {"errors.chosen.askew_rad": [about_x, about_y], "errors.chosen.indenter_m": aside}


FAMILIES: Final[Mapping[Family, Mapping[str, Callable[..., Settings]]]] = {
    Family.RELAXATION: {
        "power-law": _relaxing(_power_law),
        "box-spectrum": _relaxing(_box_spectrum),
        "muscle": _branches([(0.40, 0.60)], [(3.0, 12.0)]),
        "short": _branches([(0.40, 0.65), (0.05, 0.15)], [(0.2, 0.8), (20.0, 60.0)]),
        "long": _branches([(0.15, 0.50)], [(60.0, 300.0)]),
    },
    Family.CONTACT: {
        "slow": _contact((0.008, 0.018), None),
        "fast": _contact((0.055, 0.090), None),
        "small": _contact(None, (0.005, 0.010)),
        "large": _contact(None, (0.020, 0.030)),
        "both": _contact((0.012, 0.080), (0.006, 0.025)),
    },
    Family.BONES: {
        "ribs-nearer": _skeletal(_ribs_nearer),
        "spines-nearer": _skeletal(_spines_nearer),
        "both-nearer": _skeletal(lambda usual, by, rng: {**_ribs_nearer(usual, by, rng), **_spines_nearer(usual, by, rng)}),
        "navel-moved": _skeletal(_navel_moved),
        "narrow": _skeletal(_narrow),
        "wide": _skeletal(_wide),
        "asymmetric": _skeletal(_asymmetric),
    },
    Family.STRUCTURES: {
        "mcburney": _with(_mcburney),
        "midline": _with(_midline),
        "subcostal": _with(_subcostal),
        "ports": _with(_ports),
        "hernia": _with(_hernia),
        "diastasis": _with(_diastasis),
        "mesh": _with(_mesh),
        "stool": _with(_stool),
        "pulse": _pulse,
    },
    Family.VARIATION: {"short": _varying((0.010, 0.016), (0.006, 0.010)), "long": _varying((0.12, 0.35), (0.15, 0.40))},
    Family.EQUIPMENT: {
        "gain-high": _error_change(force_gain=_GAIN),
        "gain-low": _error_change(force_gain=-_GAIN),
        "lag": _error_change(force_lag_s=0.040),
        "askew": _askew,
    },
}
