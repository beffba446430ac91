"""Errors of arm, camera and force sensor in an examination, drawn from the distributions of whole examinations.

`loop.yaml` has a row for each setting of the errors and kind of breathing. A row fitted to fewer than LEAST_EXAMINATIONS counts
as assumed in studies. With d the measured depth and d' the true one, below the breathing skin,

    d - d' = offset + zero(stroke) + tilt . xy + field(xy) + wander(t) - (1 - followed) (excursion(t) - its mean)

and d is the set-point plus the error of regulation. Force is measured by the force/torque sensor of `palpate_robot`, tared before
each stroke. The error of registration is simulated as it is, without a distribution.
"""

from functools import cache
from importlib import resources
from math import exp
from typing import Annotated, Final, Literal, NamedTuple

import numpy as np
import yaml
from pydantic import Field, TypeAdapter
from scipy.interpolate import RectBivariateSpline
from scipy.ndimage import gaussian_filter
from scipy.signal import lfilter

from palpate.quick.patient import PERIOD_S
from palpate_bus.contract import contract
from palpate_bus.messages import NS
from palpate_errors import UserError
from palpate_models.numerics.frames import Array
from palpate_models.numerics.seeds import generator
from palpate_models.robot.arm import TOOL
from palpate_models.scenario.errors import Level, draw_errors, levels
from palpate_models.scenario.schema import Exam, Following, Scenario
from palpate_models.section import NonNegative, Positive, Section
from palpate_planning.stroke import TOUCH
from palpate_robot.sensors import FtSensor

LOOP_SECTIONS: Final = ("camera", "hand_eye", "registration", "arm")
"""Sections of the errors that are drawn; those of the force sensor are simulated."""
_STROKES: Final = 1024
_GRID_M: Final = 0.004
_BEYOND_M: Final = 0.06
"""Margin of the field of surface errors around the examined region."""

LEAST_EXAMINATIONS: Final = 10
"""Fewer examinations do not give the spread between examinations: such a row counts as assumed."""

Breath = Literal["none", "quiet", "deep", "held"]


class UnknownLoopError(UserError):
    """The scenario has no row in loop.yaml. Names its setting and the available ones."""


class Normal(Section):
    """A normal distribution over examinations."""

    mean: float = 0.0
    sd: NonNegative = 0.0

    def draw(self, rng: np.random.Generator) -> float:
        """Return the value of one examination."""
        return self.mean + self.sd * float(rng.standard_normal())


class LoopErrors(Section):
    """Distributions of the errors in examinations with one setting of errors and kind of breathing."""

    camera: Level
    hand_eye: Level
    registration: Level
    arm: Level
    breathing: Breath
    following: Following
    """Handling of breathing in the examination."""
    examinations: Annotated[int, Field(ge=0)]
    """Number of whole examinations behind these figures."""
    begin_s: Positive
    """Mean start time of the first stroke [s]."""
    aside_m: NonNegative
    """SD of lateral tool position error per axis, over examinations [m]."""
    offset_m: Normal
    """Height of the corrected surface above the true one [m]."""
    tilt: Normal
    """Slope of this height along x and y."""
    zero_m: NonNegative
    """SD over strokes of the error of a stroke's zero [m]."""
    uncertainty_m: NonNegative
    """Root mean square of the reported standard deviation of depth [m]."""
    field_m: NonNegative
    """SD of the remaining error of the surface, smooth over the skin [m]."""
    field_length_m: Positive
    """Its correlation length l [m]: covariance exp(-r^2 / 2 l^2)."""
    followed: Normal
    """Fraction of the breathing excursion that the examination follows."""
    wander_m: NonNegative
    """SD of the remaining error of depth, smooth in time [m]."""
    wander_s: Positive
    """Its correlation time T [s]: covariance (1 + t / T) exp(-t / T)."""
    regulation_m: NonNegative
    """SD of measured depth less set-point at depth [m]."""
    regulation_s: Positive
    """Its correlation time [s], as of the wander."""

    def draw(self, rng: np.random.Generator) -> "Drawn":
        """Draw the constant errors of one examination."""
        aside = self.aside_m * rng.standard_normal(2)
        offset, tilt = self.offset_m.draw(rng), np.array((self.tilt.draw(rng), self.tilt.draw(rng)))
        return Drawn(offset, tilt, self.followed.draw(rng), aside, self.zero_m * rng.standard_normal(_STROKES))


class Drawn(NamedTuple):
    """Constant errors of one examination."""

    offset_m: float
    """Height of the perceived above the true surface at the centre of the region [m]."""
    tilt: Array
    """Slope of this height along x and y, shape (2,)."""
    followed: float
    """Fraction of the breathing excursion that is followed."""
    aside_m: Array
    """True less estimated position of the tool [m], xy of A, shape (2,)."""
    zeros_m: Array
    """Errors of the zeros of successive strokes [m]; repeated after the last."""


@cache
def known_loops() -> tuple[LoopErrors, ...]:
    """Return the rows of loop.yaml."""
    text = resources.files("palpate.quick").joinpath("loop.yaml").read_text(encoding="utf-8")
    return tuple(TypeAdapter(list[LoopErrors]).validate_python(yaml.safe_load(text)["loops"]))


def setting_of(scenario: Scenario) -> dict[str, str | None]:
    """Return the level of each section of errors, None for a user-defined one; and the breathing."""
    sections: dict[str, str | None] = {}
    for name in LOOP_SECTIONS:
        given = getattr(scenario.errors, name)
        kind = type(given)
        of_level = {"none": kind(), **{level: kind(**fields.get(name, {})) for level, fields in levels().items()}}
        sections[name] = next((level for level, section in of_level.items() if section == given), None)
    return {**sections, "breathing": scenario.phantom.breathing.kind, "following": scenario.exam.breathing.value}


def loop_errors(scenario: Scenario) -> LoopErrors:
    """Return the distributions for a scenario. Raises UnknownLoopError if loop.yaml has no row for it."""
    wanted = setting_of(scenario)
    for row in known_loops():
        if all(getattr(row, name) == value for name, value in wanted.items()):
            return row
    known = "; ".join(", ".join(f"{name} {getattr(row, name)}" for name in wanted) for row in known_loops())
    own = [name for name, level in wanted.items() if level is None]
    setting = ", ".join(f"{name} {value or 'user-defined'}" for name, value in wanted.items())
    raise UnknownLoopError(
        f"{scenario.name}: no fitted error model for {setting}"
        + (f" (errors.{own[0]} is user-defined)" if own else "")
        + f"; available: {known}; or use tier: whole"
    )


class Loop:
    """Errors of one examination. Equal scenarios have equal errors."""

    def __init__(self, scenario: Scenario, errors: LoopErrors, drawn: Drawn | None = None) -> None:
        """Draw from the scenario's seed; `drawn` replaces the constant errors."""
        rng = generator(scenario.seed, "loop")
        mine = errors.draw(rng)
        self._drawn = drawn or mine
        self.begin_s = errors.begin_s
        """Start time of the first stroke [s]."""
        self.aside_m = self._drawn.aside_m + scenario.errors.chosen.indenter_m
        """True less estimated position of the tool, xy of A [m], shape (2,)."""
        self.uncertainty_m = errors.uncertainty_m
        """Reported standard deviation of depth [m]."""
        self.followed = self._drawn.followed
        """Fraction of the breathing excursion that is followed."""
        self._centre = np.array(scenario.exam.centre_m)
        self._field = _field(scenario.exam, errors.field_m, errors.field_length_m, rng)
        self.regulation = _Smooth(errors.regulation_m, errors.regulation_s, rng)
        """Measured depth less set-point [m]."""
        self.wander = _Smooth(errors.wander_m, errors.wander_s, rng)
        """Remaining error of depth [m]."""
        self.sensor = _TaredSensor(scenario, self.begin_s)

    def wrong(self, xy: Array) -> Array:
        """Return the height of the perceived above the true surface at points [m], shape (p, 2) -> (p,)."""
        return np.asarray(self._drawn.offset_m + (xy - self._centre) @ self._drawn.tilt + self._field.ev(xy[:, 0], xy[:, 1]))

    def zero(self, stroke: int) -> float:
        """Return the error of the zero of a stroke, counted from 1 [m]."""
        return float(self._drawn.zeros_m[(stroke - 1) % len(self._drawn.zeros_m)])


def _field(exam: Exam, sd: float, length: float, rng: np.random.Generator) -> RectBivariateSpline:
    """Return a smooth random field over the examined region and a margin [m]."""
    halves = [0.5 * size + _BEYOND_M for size in exam.region_m]
    x, y = (c + np.linspace(-h, h, round(2 * h / _GRID_M) + 1) for c, h in zip(exam.centre_m, halves, strict=True))
    width = length / np.sqrt(2) / _GRID_M  # white noise under a Gaussian of this width has the wanted covariance
    noise = gaussian_filter(rng.standard_normal((len(x), len(y))), width, mode="wrap")
    peak = np.zeros((len(x), len(y)))
    peak[0, 0] = 1.0
    unit = np.sqrt(np.sum(gaussian_filter(peak, width, mode="wrap") ** 2))
    return RectBivariateSpline(x, y, sd / unit * noise)


class _Smooth:
    """A process with the covariance (1 + t / T) exp(-t / T): white noise through two equal lags; one value per PERIOD_S."""

    _BLOCK = 4096

    def __init__(self, sd: float, time_s: float, rng: np.random.Generator) -> None:
        self._rng = np.random.Generator(np.random.PCG64(rng.bit_generator.seed_seq.spawn(1)[0]))  # type: ignore[attr-defined]
        a = exp(-PERIOD_S / time_s)
        self._lags = np.array((1.0, -2 * a, a * a))
        gain = (1 - a * a) ** 3 / (1 + a * a)  # variance of white noise for a process of unit variance
        self._scale = sd * np.sqrt(gain)
        self._memory = np.zeros(2)
        warm = round(20 * time_s / PERIOD_S)
        self._next(warm)
        self._values: list[float] = []

    def _next(self, count: int) -> Array:
        values, self._memory = lfilter((1.0,), self._lags, self._scale * self._rng.standard_normal(count), zi=self._memory)
        return np.asarray(values)

    def at(self, k: int) -> float:
        """Return the value in the k-th period."""
        while k >= len(self._values):
            self._values += self._next(self._BLOCK).tolist()
        return self._values[k]


class _TaredSensor:
    """The normal force of the force sensor.

    Its z axis is along the inward normal, x near that of A; readings are means over PERIOD_S, as `robot/status` has them.
    """

    def __init__(self, scenario: Scenario, begin_s: float) -> None:
        drawn = draw_errors(scenario.errors, scenario.seed).force
        per_reading = contract().roles["robot"].period / NS
        quieter = {name: getattr(drawn.given, name) * np.sqrt(per_reading / PERIOD_S) for name in ("noise_n", "noise_nm")}
        drawn = drawn._replace(given=drawn.given.model_copy(update=quieter))
        self._sensor = FtSensor(drawn, generator(scenario.seed, "loop force"), PERIOD_S)
        self._begin = round(begin_s / PERIOD_S)
        self._normal: list[float] = []
        self._tare, self._felt = 0.0, 0.0
        self._lag = exp(-PERIOD_S / drawn.lag_s) if drawn.lag_s else 0.0
        self.tare(0)
        reads, lever = drawn.sensitivity[2], TOOL.ft_to_indenter_m
        self._row = np.array((reads[0] + lever * reads[4], reads[1] - lever * reads[3], reads[2]))
        """Reading of z for a unit force at the sphere's centre along each of the sensor's axes, shape (3,)."""

    def _read(self, k: int) -> None:
        """Simulate the readings up to the k-th since the sensor was switched on."""
        while k >= len(self._normal):
            self._normal += (-self._sensor.block()[:, 2]).tolist()

    def gains(self, outward: Array) -> Array:
        """Return rows that map a force to the measured normal force, for outward normals, both of shape (p, 3)."""
        z = -outward
        x = np.array((1.0, 0.0, 0.0)) - z[:, :1] * z
        x /= np.linalg.norm(x, axis=1, keepdims=True)
        axes = np.stack((x, np.cross(z, x), z), axis=1)
        return np.asarray(-np.einsum("i,pij->pj", self._row, axes))

    def lagging(self, force: float) -> float:
        """Return what the sensor reads of a normal force [N] at the end of a period; called once per period."""
        self._felt = force + self._lag * (self._felt - force)
        return self._felt

    def tare(self, k: int) -> None:
        """Tare the sensor by its readings in air just before the k-th period."""
        self._read(self._begin + k)
        now = self._begin + k
        self._tare = float(np.mean(self._normal[max(now - round(TOUCH.tare_s / PERIOD_S), 0) : now]))

    def tared_reading(self, k: int) -> float:
        """Return the reading in the k-th period without a force, along the outward normal [N]."""
        self._read(self._begin + k)
        return self._normal[self._begin + k] - self._tare
