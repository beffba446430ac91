"""Motion of the patient: breathing and coughing, as a table of breaths drawn from the seed, and one motion of the whole body on
the table, without moving back.

Marks of certainty: [V] read in the source (its abstract), [A] assumed.
"""

import math
from bisect import bisect_right
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, model_validator
from scipy.spatial.transform import Rotation

from palpate_models.numerics.frames import Array
from palpate_models.numerics.seeds import generator, generators
from palpate_models.section import Ends, NonNegative, Positive, Section

TABLE_S = 600.0
"""Minimum length of the table of breaths [s]; after it the breaths repeat."""
MOST_M = 0.04
"""Maximum displacement by a breath or cough [m]."""
_DEEP = {"peak_to_peak_m": 0.025, "rate_per_min": 7.4, "depth_cv": 0.1}
"""Defaults of kind `deep`. Rate: Ragnarsdottir 2006 [V]; depth: more than three times the quiet one (Kaneko and Horie 2012)
[V]; its variation [A]."""
_MOST_SHARE = 0.8
"""Maximum share of inspiration in the motion of a breath."""
_COUGH_S = (0.15, 0.25, 0.10)
"""Rise, fall and rest of a cough in a burst [s] [A]."""

Share = Annotated[float, Field(ge=0, lt=1)]


class Breathing(Section):
    """Abdominal breathing. The rest position of the wall is the end of expiration."""

    kind: Literal["none", "quiet", "deep", "held"] = "quiet"
    """`deep` has other defaults: 25 mm, 7.4 per minute, `depth_cv` 0.1. `held`: quiet, with holds at the end of
    expiration."""
    peak_to_peak_m: Annotated[float, Field(gt=0, le=MOST_M)] = 0.008
    """Mean depth of a breath at the umbilicus: 5 to 12 mm quiet, 25 mm deep [A]; 7.5 mm follow from a tidal volume of 0.5 l."""
    rate_per_min: Annotated[float, Field(ge=4, le=40)] = 14.0
    """Breaths per minute while the breath is not held: 14 at rest, n = 100 (Ragnarsdottir and Kristinsdottir 2006) [V]."""
    expiration_ratio: Annotated[float, Field(ge=0.5, le=4)] = 1.2
    """Mean duration of expiration without its pause, relative to inspiration: 1.21 for men, 1.14 for women (same source) [V]. The
    source does not say if it includes the pause."""
    pause: Annotated[float, Field(ge=0, le=0.5)] = 0.1
    """Share of the pause after expiration in a breath [A]."""
    duration_cv: Share = 0.208
    """Variation of duration between breaths, log-normal (Tobin 1988, n = 65: 20.8 +- 11.5 % of the frequency) [V]."""
    depth_cv: Share = 0.33
    """Variation of depth between breaths, log-normal (Tobin 1988: 33 +- 14.9 % of the tidal volume) [V]."""
    timing_cv: Share = 0.179
    """Variation of inspiration's share of a breath, log-normal (Tobin 1988: 17.9 +- 6.5 %) [V]."""
    memory: Share = 0.28
    """Correlation of duration, depth and share of inspiration with the previous breath (Tobin 1995: 0.26 of
    the expiratory time, 0.30 of the tidal volume, 0.20 of the inspiratory time) [V]."""
    breathes_s: Positive = 40.0
    """Time of breathing between holds (kind: held) [A]."""
    held_s: Annotated[float, Field(gt=0, le=120)] = 20.0
    """Duration of each hold (kind: held) [A]."""
    coughs_per_min: Annotated[float, Field(ge=0, le=20)] = 0.0
    """Bursts of two or three coughs per minute, at random times, each after the current breath."""
    cough_m: Ends[Annotated[float, Field(ge=0, le=MOST_M)]] = (0.010, 0.020)
    """Range of the displacement by a cough, uniform [A]. The tension of the wall during a cough is not modelled."""

    pulse_m: Annotated[float, Field(ge=0, le=0.005)] = 0.0
    """Peak to peak displacement by the pulse of the aorta, with the profile of a breath [A]."""
    pulse_per_min: Annotated[float, Field(ge=30, le=180)] = 70.0
    """Heart rate."""

    @model_validator(mode="before")
    @classmethod
    def _usual(cls, values: Any) -> Any:
        return _DEEP | values if isinstance(values, dict) and values.get("kind") == "deep" else values


class BreathingCurve:
    """Breathing of one patient as a function of time, defined by `table`.

    A breath (s, T_i, T_e, T_p, A) that started x = t - s ago displaces the wall by

        A (1 - cos(pi x / T_i)) / 2              for x < T_i
        A (1 + cos(pi (x - T_i) / T_e)) / 2      for T_i <= x < T_i + T_e
        0                                        for T_i + T_e <= x < T_i + T_e + T_p

    (raised cosines [A]), continuous with its derivative, to which the pulse adds P (1 - cos(2 pi f t)) / 2. The current breath at
    time t is the last one that starts at or before t - L floor((t - s_0) / L): the table repeats after L = `repeats_s`. The first
    start s_0 is before time 0.
    """

    def __init__(self, breathing: Breathing, seed: int) -> None:
        """Equal settings and seed give equal breaths."""
        self.table: Array = np.empty((0, 5)) if breathing.kind == "none" else _breaths(breathing, seed)
        """Start [s], inspiration [s], expiration [s], pause [s] and amplitude [m] of each breath or cough, shape (n, 5)."""
        self._pulse_m = breathing.pulse_m if len(self.table) else 0.0
        self._pulse_radps = 2 * math.pi * breathing.pulse_per_min / 60
        self.largest_m = float(self.table[:, 4].max(initial=0.0)) + self._pulse_m
        """Maximum excursion [m]."""
        self.repeats_s = float(self.table[:, 1:4].sum())
        """Length of the table [s]; 0 without breathing."""
        moving = self.table[:, 1:3].sum(axis=1)
        self.mean_m = float(self.table[:, 4] @ moving / 2 / self.repeats_s) + self._pulse_m / 2 if self.repeats_s else 0.0
        """Mean excursion [m]: half of the amplitude during a breath, zero in its pause."""
        self._rows = self.table.tolist()
        self._starts = self.table[:, 0].tolist()

    def excursion(self, t_s: float) -> float:
        """Return the outward displacement [m], never negative, at time `t_s` [s] where the profile is 1."""
        if not self._rows:
            return 0.0
        return self._breath(t_s) + self._pulse_m * (1 - math.cos(self._pulse_radps * t_s)) / 2

    def _breath(self, t_s: float) -> float:
        """Return the part of the breath [m]."""
        t_s -= self.repeats_s * math.floor((t_s - self._starts[0]) / self.repeats_s)
        start, inspiration, expiration, _, amplitude = self._rows[max(bisect_right(self._starts, t_s) - 1, 0)]
        since = t_s - start
        if since < inspiration:
            return float(amplitude * (1 - math.cos(math.pi * since / inspiration)) / 2)
        since -= inspiration
        return float(amplitude * (1 + math.cos(math.pi * since / expiration)) / 2) if since < expiration else 0.0


STILL = BreathingCurve(Breathing(kind="none"), 0)
"""No breathing."""


def _breaths(breathing: Breathing, seed: int) -> Array:
    """Return the table of breaths, shape (n, 5)."""
    breaths, coughs = generators(seed, "breathing", 2)
    rows: list[tuple[float, float, float, float, float]] = []
    z = breaths.standard_normal(3)
    share = (1 - breathing.pause) / (1 + breathing.expiration_ratio)
    clock = -breaths.uniform(0, 60 / breathing.rate_per_min)
    next_hold, next_cough = clock + breathing.breathes_s, _until_next(breathing, coughs)
    while clock < TABLE_S:
        duration = 60 / breathing.rate_per_min * _log_normal(breathing.duration_cv, z[0])
        depth = breathing.peak_to_peak_m * _log_normal(breathing.depth_cv, z[1])
        pause = breathing.pause * duration
        inspiration = duration * min(share * _log_normal(breathing.timing_cv, z[2]), _MOST_SHARE * (1 - breathing.pause))
        expiration = duration - pause - inspiration
        z = breathing.memory * z + math.sqrt(1 - breathing.memory**2) * breaths.standard_normal(3)
        if breathing.kind == "held" and clock + duration >= next_hold:
            pause += breathing.held_s
            next_hold = clock + duration + breathing.held_s + breathing.breathes_s
        rows.append((clock, inspiration, expiration, pause, min(depth, MOST_M)))
        clock += inspiration + expiration + pause
        while next_cough <= clock:
            next_cough += _until_next(breathing, coughs)
            for _ in range(int(coughs.integers(2, 4))):
                rows.append((clock, *_COUGH_S, float(coughs.uniform(*breathing.cough_m))))
                clock += sum(_COUGH_S)
    return np.array(rows)


def _until_next(breathing: Breathing, rng: np.random.Generator) -> float:
    """Draw the time to the next burst of coughs [s], exponential."""
    return float(rng.exponential(60 / breathing.coughs_per_min)) if breathing.coughs_per_min else math.inf


def _log_normal(cv: float, z: float) -> float:
    """Return a log-normal variable of mean 1 and coefficient of variation `cv` at normal score `z`."""
    variance = math.log1p(cv**2)
    return math.exp(math.sqrt(variance) * z - variance / 2)


_MIDDLE_S = (40.0, 90.0)
"""Range of the drawn time of motion [s]: within the scan of the default examination."""
_AXIS_BELOW_M = 0.10
"""Depth of the axis of rotation below the umbilicus [m] [A]: the spine."""


class Motion(Section):
    """Rigid motion of the whole body at one time. Sizes [A]: a shift of 5 to 20 mm, or a turn of 3 degrees."""

    kind: Literal["none", "shift", "turn"] = "none"
    """`shift`: along the table. `turn`: about the long axis. Direction and side are drawn from the seed."""
    shift_m: Annotated[float, Field(gt=0, le=0.02)] = 0.010
    """Distance of the shift."""
    turn_rad: Annotated[float, Field(gt=0, le=0.2)] = math.radians(3)
    """Angle of the turn."""
    at_s: NonNegative | None = None
    """Start of the motion; None: drawn from the seed, between 40 and 90 s."""
    over_s: Annotated[float, Field(ge=0.1, le=10)] = 0.5
    """Duration of the motion."""


class BodyMotion:
    """Pose of the body over time: A' is the moving frame of the body, A its frame before the motion.

    With s(x) = x^2 (3 - 2 x) from 0 to 1 over x = (t - at_s) / over_s, the body is shifted by s d, or turned by s theta about
    the line through p along e. Both are in A.
    """

    def __init__(self, motion: Motion, seed: int) -> None:
        """Equal settings and seed give an equal motion."""
        rng = generator(seed, "motion")
        middle, direction, side = rng.uniform(*_MIDDLE_S), rng.uniform(0, 2 * math.pi), rng.choice((-1.0, 1.0))
        self.at_s = float(middle) if motion.at_s is None else motion.at_s
        """Start [s]."""
        self.until_s = self.at_s + motion.over_s
        """End [s]."""
        self._d = np.zeros(3)
        self._theta = np.zeros(3)
        self._p = np.array((0.0, 0.0, -_AXIS_BELOW_M))
        if motion.kind == "shift":
            self._d = motion.shift_m * np.array((math.cos(direction), math.sin(direction), 0.0))
        elif motion.kind == "turn":
            self._theta = motion.turn_rad * np.array((0.0, side, 0.0))
        self.moves = motion.kind != "none"
        """True if there is a motion."""

    def pose(self, t_s: float) -> Array:
        """Return X_AA' at time `t_s` [s], shape (4, 4): the identity before the motion."""
        x = self._part(t_s)
        s = x * x * (3 - 2 * x)
        X = np.eye(4)
        X[:3, :3] = Rotation.from_rotvec(s * self._theta).as_matrix()
        X[:3, 3] = s * self._d + self._p - X[:3, :3] @ self._p
        return X

    def on_body(self, t_s: Array, p: Array) -> Array:
        """Return points of A [m], shape (k, 3), at times [s], shape (k,), expressed in A', shape (k, 3)."""
        if not self.moves:
            return p
        x = np.clip((t_s - self.at_s) / (self.until_s - self.at_s), 0.0, 1.0)
        s = (x * x * (3 - 2 * x))[:, None]
        return np.asarray(Rotation.from_rotvec(-s * self._theta).apply(p - s * self._d - self._p) + self._p)

    def twist(self, t_s: float) -> tuple[Array, Array]:
        """Return the body's velocity in A at time `t_s` [s]: v [m/s] and w [rad/s], shape (3,) each.

        A point of the body at r moves with v + w x r.
        """
        x = self._part(t_s)
        rate = 6 * x * (1 - x) / (self.until_s - self.at_s)
        w = rate * self._theta
        return rate * self._d - np.cross(w, self._p), w

    def _part(self, t_s: float) -> float:
        return min(max((t_s - self.at_s) / (self.until_s - self.at_s), 0.0), 1.0)
