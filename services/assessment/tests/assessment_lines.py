"""Samples along lines over a belly whose log-force is a known function of place, with errors of your own choice."""

from collections.abc import Callable

import numpy as np

from palpate_assessment.assess import MapGrid, map_grid
from palpate_assessment.model import Regression, prior_log_amplitudes
from palpate_assessment.sampling import ForceSample
from palpate_assessment.shapes import Bump
from palpate_assessment.standard import USUAL, Observations, load_calibration, observe

REGION = 0.14
SPACING, ALONG, SPEED = 0.0125, 0.005, 0.03
LEVEL, UP = float(np.log(2.5)), np.array((0.0, 0.0, 1.0))
Field = Callable[[np.ndarray], np.ndarray]


def flat_grid(pitch: float = 0.005) -> MapGrid:
    axis = np.arange(-0.1, 0.1001, 0.005)
    x, y = np.meshgrid(axis, axis)
    surface = np.column_stack((x.ravel(), y.ravel(), np.zeros(x.size)))
    return map_grid(surface, (0.0, 0.0), (REGION, REGION), 0.02, pitch)


def level(xy: np.ndarray) -> np.ndarray:
    return np.full(len(xy), LEVEL)


def lump(xy: np.ndarray, centre: tuple[float, float], radius: float, contrast: float) -> np.ndarray:
    """Log of the felt contrast of a lump with an edge as wide as an indenter feels it."""
    beyond = np.linalg.norm(xy - centre, axis=1) - radius
    return np.log(contrast) / (1 + np.exp(beyond / 0.004))


def natural(seed: int, sd: float, length: float = 0.05) -> Field:
    """Return a smooth random field, by random Fourier features."""
    rng = np.random.Generator(np.random.PCG64(seed))
    frequencies, phases = rng.standard_normal((2, 256)) / length, rng.uniform(0, 2 * np.pi, 256)
    return lambda xy: sd * np.sqrt(2 / 256) * np.cos(xy @ frequencies + phases).sum(axis=1)


def lines(
    field: Field,
    seed: int = 0,
    stroke_m: float = 0.0,
    breathing_m: float = 0.0,
    noise: float = 0.01,
    conversion: float = 0.0,
    exponent: Field | None = None,
) -> list[ForceSample]:
    """A stroke for each line, there and back, each from a held press; `stroke_m` is the error of each one's zero, `breathing_m`
    what breathing leaves, `conversion` the log of slide over press less the usual one, `exponent` that of the descents.
    """
    rng = np.random.Generator(np.random.PCG64(seed))
    calibration = load_calibration()
    along = np.arange(-REGION / 2, REGION / 2 + 1e-9, ALONG)
    samples = []
    for stroke, y in enumerate(np.arange(-REGION / 2, REGION / 2 + 1e-9, SPACING)):
        forth = 1 if stroke % 2 == 0 else -1
        zero = stroke_m * rng.standard_normal()
        for k, x in enumerate(along[::forth]):
            time = 10.0 * stroke + k * ALONG / SPEED
            wrong = zero + breathing_m * np.sqrt(2) * np.sin(2 * np.pi * time / 4.3)
            felt = np.array((x + (calibration.lead_s * forth * SPEED if k else 0.0), y))
            log_force = field(felt[None])[0] + calibration.exponent * np.log1p(wrong / 0.01)
            log_force += calibration.conversion + conversion if k else calibration.held
            force = float(np.exp(log_force + noise * rng.standard_normal()))
            velocity, unsure = np.array((forth * SPEED if k else 0.0, 0.0, 0.0)), float(np.hypot(stroke_m, breathing_m))
            steep = 0.0 if k else float(calibration.exponent if exponent is None else exponent(felt[None])[0])
            held = (0.010, force, 0.01, k * ALONG / SPEED, False, stroke, unsure, steep)
            samples.append(ForceSample(time, np.array((x, y, 0.0)), UP, velocity, *held))
    return samples


def observations(samples: list[ForceSample]) -> Observations:
    o = observe(samples, USUAL)
    assert o is not None
    return o


def regression(samples: list[ForceSample], *lumps: Bump) -> Regression:
    """Return the regression with the amplitudes of the prior."""
    o = observations(samples)
    return Regression(o, lumps, prior_log_amplitudes(o))
