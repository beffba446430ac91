"""Natural variation of a person's wall, by random fields outside the model class of the assessment, and its tension by guarding.

A field is a weighted sum of two components. Each has a family, a length, an anisotropy and a direction of its own, and none is
Gaussian: ridges have crests, patches have borders, hills are log-normal, and waves have heavy-tailed frequencies and weights.
Fields are functions of position, made from random Fourier features (Rahimi and Recht 2007), and do not depend on the mesh.

The ratio by which guarding raises the force in a scenario is one of forces, as measured on people. The tension acts on the
foundation alone, not on the shear layer, so it exceeds the ratio; it is solved for on a flat uniform wall with the scenario's
mechanics.
"""

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Final, NamedTuple

import numpy as np
from scipy.linalg import solve_banded
from scipy.optimize import brentq

from palpate_models.numerics.frames import Array, Mask
from palpate_models.numerics.seeds import generator
from palpate_models.patient import wall
from palpate_models.patient.abdomen import bone_share, parametric_surface
from palpate_models.patient.field import edge_distance, smoothstep
from palpate_models.patient.mesh import MeshError
from palpate_models.patient.schema import Anatomy, Muscles, Stiffness
from palpate_models.patient.wall import Guarding


class VariationTuning(NamedTuple):
    """Random fields of a person, and what muscles add."""

    features: int = 96
    components: int = 2
    max_anisotropy: float = 3.0
    """Largest ratio of the lengths along and across a component's direction [A]."""
    max_sd: float = 3.0
    """Bound of a field in standard deviations: healthy tissue has no extreme places."""
    muscle_edge_m: float = 0.010
    """Width of the transition between bands [A]."""
    min_random_share: float = 0.3
    """Minimum share of the random variation next to muscles."""
    coarse_m: float = 0.02
    belly_half_m: float = 0.10


VARIATION: Final = VariationTuning()


Family = Callable[[Array], Array]


class _Waves(NamedTuple):
    """sum_k weight_k cos(frequency_k . p + phase_k)."""

    frequency: Array
    phase: Array
    weight: Array

    def __call__(self, points: Array) -> Array:
        return np.asarray(np.cos(points @ self.frequency + self.phase) @ self.weight)


def _waves(rng: np.random.Generator, lengths: Array, heavy: bool) -> _Waves:
    """Waves of unit variance whose correlation falls over `lengths` [m] along three axes, turned about z by a random angle.

    `heavy`: Student frequencies, so the correlation is Matern's of smoothness 3/2, and Student weights: a few waves stand out.
    """
    frequency = rng.standard_normal((3, VARIATION.features))
    weight = np.ones(VARIATION.features)
    if heavy:
        frequency /= np.sqrt(rng.chisquare(3, VARIATION.features) / 3)
        weight = rng.standard_t(3, VARIATION.features)
    angle = rng.uniform(0, np.pi)
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    phase = rng.uniform(0, 2 * np.pi, VARIATION.features)
    return _Waves(turn @ (frequency / lengths[:, None]), phase, weight * np.sqrt(2 / (weight**2).sum()))


_FAMILIES: tuple[Family, ...] = (
    lambda g: -np.sqrt(g**2 + 0.01),
    lambda g: np.tanh(3 * g),
    lambda g: np.exp(0.8 * g),
    lambda g: g,
)
"""Transformations of waves to ridges, patches and hills; the last one keeps heavy-tailed waves."""


class _Component(NamedTuple):
    """Transformed waves with their mean and deviation over the reference points, and their weight."""

    waves: _Waves
    family: Family
    weight: float
    mean: float = 0.0
    sd: float = 1.0

    def __call__(self, points: Array) -> Array:
        return self.family(self.waves(points))


def _component(rng: np.random.Generator, length_m: tuple[float, float], share: float, reference: Array) -> _Component:
    """Draw a component with this share of the field's variance: family, lengths and direction."""
    family = _FAMILIES[int(rng.integers(len(_FAMILIES)))]
    length = np.exp(rng.uniform(*np.log(length_m)))
    longer = np.exp(rng.uniform(0, np.log(VARIATION.max_anisotropy)))
    lengths = np.array((min(length * longer, length_m[1]), length, length))
    part = _Component(_waves(rng, lengths, heavy=family is _FAMILIES[-1]), family, float(np.sqrt(share)))
    values = part(reference)
    return part._replace(mean=float(values.mean()), sd=float(values.std()))


class NaturalField:
    """A random field over a body, of mean 0 and standard deviation 1 over reference points on it."""

    def __init__(self, rng: np.random.Generator, length_m: tuple[float, float], reference: Array) -> None:
        """`length_m`: the shortest and the longest length of a component [m]; `reference` (m, 3) in A [m]."""
        shares = rng.dirichlet(np.ones(VARIATION.components))
        self._parts = [_component(rng, length_m, float(share), reference) for share in shares]
        total = self._sum(reference)
        self._middle, self._reach = float(total.mean()), VARIATION.max_sd * float(total.std())
        bounded = self._bound(reference)
        self._mean, self._sd = float(bounded.mean()), float(bounded.std())

    def _sum(self, points: Array) -> Array:
        total = np.zeros(len(points))
        for part in self._parts:
            total += part.weight * (part(points) - part.mean) / part.sd
        return total

    def _bound(self, points: Array) -> Array:
        return np.tanh((self._sum(points) - self._middle) / self._reach)

    def __call__(self, points: Array) -> Array:
        """Return the field at points (n, 3) of A [m], shape (n,)."""
        return np.asarray((self._bound(points) - self._mean) / self._sd)


class HealthyWall(NamedTuple):
    """Wall of a person relative to its mean, at n points."""

    stiffness: Array
    """Factor on the foundation modulus [1], shape (n,)."""
    stiffening: Array
    """Stiffening [1/m], shape (n,)."""


def belly(size_m: tuple[float, float, float], anatomy: Anatomy) -> Array:
    """Return reference points on the belly [m], shape (m, 3): the front within 0.1 m of the umbilicus, without bones."""
    shape = parametric_surface(size_m, VARIATION.coarse_m, anatomy)
    x, y, _ = shape.vertices.T
    near = (np.abs(x) <= VARIATION.belly_half_m) & (np.abs(y) <= VARIATION.belly_half_m) & (shape.normals[:, 2] > 0.5)
    return np.asarray(shape.vertices[near & (bone_share(x, y, anatomy.skeleton) < 0.01)])


def muscle_factor(x: Array, y: Array, muscles: Muscles) -> Array:
    """Return the stiffness relative to the sides at points [m]. The linea alba narrows below the umbilicus."""
    middle = muscles.linea_alba_m / 2 * (0.75 + 0.25 * np.tanh(y / 0.03))
    away = np.abs(x)
    alba = smoothstep(0.5 - (away - middle) / VARIATION.muscle_edge_m)
    within = smoothstep(0.5 - (away - middle - muscles.rectus_m) / VARIATION.muscle_edge_m)
    return np.asarray(1 + (muscles.linea_alba - 1) * alba + (muscles.rectus - 1) * (within - alba))


def healthy_wall(
    points: Array, size_m: tuple[float, float, float], anatomy: Anatomy, stiffening: float, seed: int
) -> HealthyWall:
    """Return the wall of a person with mean `stiffening` [1/m] at points (n, 3) of A [m].

    Over the belly the log factor has mean 0, and both fields have the deviations and the correlation of `anatomy.variation`. The
    part that muscles do not explain is a random field. The effect of bone is added after that.
    """
    variation = anatomy.variation
    reference = belly(size_m, anatomy)
    rng = generator(seed, "variation")
    level, other = (NaturalField(rng, variation.length_m, reference) for _ in range(2))
    at_belly = np.log(muscle_factor(reference[:, 0], reference[:, 1], anatomy.muscles))
    random = np.sqrt(max(variation.stiffness**2 - at_belly.var(), (VARIATION.min_random_share * variation.stiffness) ** 2))
    x, y = points[:, 0], points[:, 1]
    log_level = np.log(muscle_factor(x, y, anatomy.muscles)) - at_belly.mean() + random * level(points)
    total = np.sqrt(random**2 + at_belly.var())
    rho = variation.correlation
    shared = rho * log_level / total if total > 0 else 0.0
    local = np.maximum(stiffening + variation.stiffening_per_m * (shared + np.sqrt(1 - rho**2) * other(points)), 0.0)
    bone = bone_share(x, y, anatomy.skeleton)
    return HealthyWall(
        np.exp(log_level) * (1 + (anatomy.bone - 1) * bone), (1 - bone) * local + bone * anatomy.bone_stiffening_per_m
    )


RADIUS_M, DEPTH_M, SPEED_MPS = 0.010, 0.010, 0.005
"""The press in which the ratio is defined: that of the measured people (Remus 2024)."""
_RINGS = 800
_MOST_ROUNDS = 200


def tension_field(xy: Array, areas: Sequence[Guarding], stiffness: Stiffness, front: Mask) -> Array:
    """Return the tension over k_w [1] of contracted muscle at points (n, 2) of A [m], shape (n,); 0 where `front` is false.

    It rises over `edge_m`, centred on the outline. The larger tension counts where areas overlap. Raises MeshError if an area
    contains none of the points.
    """
    tension = np.zeros(len(xy))
    for index, area in enumerate(areas):
        share = np.where(front, smoothstep(0.5 - edge_distance(xy, area) / area.edge_m), 0.0)
        if not share.any():
            raise MeshError(
                f"phantom.guarding[{index}]: centre_m {area.centre_m}, radii_m {area.radii_m}: no point of the abdomen's front "
                "belongs to it (expected metres from the umbilicus)"
            )
        np.maximum(tension, tension_of_ratio(area.ratio, stiffness) * share, out=tension)
    return tension


@lru_cache(maxsize=64)
def tension_of_ratio(ratio: float, stiffness: Stiffness) -> float:
    """Return the tension relative to k_w [1] at which the force of the defining press is `ratio` times the relaxed one."""
    relaxed = pressed_force(stiffness, 0.0)
    bound = 2.0
    while pressed_force(stiffness, bound) < ratio * relaxed:
        bound *= 2
    return float(brentq(lambda tension: pressed_force(stiffness, tension) - ratio * relaxed, 0.0, bound, rtol=1e-6))


def pressed_force(stiffness: Stiffness, tension: float, depth_m: float = DEPTH_M) -> float:
    """Return the force [N] on the sphere at the end of the defining press, or one to `depth_m` [m], on a flat nominal wall.

        left (u - l^2 lap u) + drag u + sigma(u) + tension u = p / k_w,   p >= 0,  u >= w,  p (u - w) = 0

    is solved on rings around the axis. `left` is the unrelaxed share after a linear ramp of duration depth / SPEED_MPS, `drag`
    the share of the dashpot. Contact: primal-dual active set, with sigma linearised in each iteration (Newton).
    """
    seconds = depth_m / SPEED_MPS
    g, tau = np.array(stiffness.prony_g), np.array(stiffness.prony_tau_s)
    left = 1 - float(g @ (1 - tau / seconds * (1 - np.exp(-seconds / tau))))
    drag = stiffness.dashpot_s / seconds
    width = (RADIUS_M + 8 * stiffness.length_m) / _RINGS
    r = (np.arange(_RINGS) + 0.5) * width
    area = 2 * np.pi * r * width
    tie = 2 * np.pi * np.arange(1, _RINGS) * left * stiffness.length_m**2  # between a ring and the next
    stiffening = np.full(_RINGS, stiffness.stiffening_per_m)
    linear = area * (left + drag + tension)
    linear[:-1] += tie
    linear[1:] += tie
    w = np.where(r < RADIUS_M, depth_m - RADIUS_M + np.sqrt(np.maximum(RADIUS_M**2 - r**2, 0.0)), -1.0)
    u = np.maximum(w, 0.0)
    held = w > 0.5 * depth_m
    for _ in range(_MOST_ROUNDS):
        sigma, slope = wall.stress(u, stiffening), wall.slope(u, stiffening)
        bands = np.zeros((3, _RINGS))
        bands[0, 1:], bands[1], bands[2, :-1] = -tie, linear + area * slope, -tie
        load = area * (slope * u - sigma)
        row = bands.copy()
        row[1, held] = 1.0
        row[0, 1:][held[:-1]] = 0.0
        row[2, :-1][held[1:]] = 0.0
        last, u = u, solve_banded((1, 1), row, np.where(held, w, load))
        force = bands[1] * u - load
        force[:-1] -= tie * u[1:]
        force[1:] -= tie * u[:-1]
        touching = np.where(held, force > 0, u < w)
        if (touching == held).all() and np.abs(u - last).max() < 1e-9:
            return float(stiffness.k_w_n_per_m3 * force[held].sum())
        held = touching
    raise RuntimeError(f"the press on a flat wall did not settle in {_MOST_ROUNDS} rounds: {stiffness}, tension = {tension}")
