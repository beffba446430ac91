"""A patient under the hand: the true tissue of a scenario, and an indenter that is moved through it without an arm.

    patient = Patient(load_scenario("person", seed=7))
    touch = patient.press((0.03, -0.02), depth=0.010, speed=0.02, hold=0.5)
    touch.force.max()

Everything is in the abdomen frame A: x to the patient's left, y to the head, z outward, from the umbilicus, where the patient
truly lies. He breathes, guards and moves as the scenario says, and remembers what was pressed before.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np

from palpate.truth.surface import TrueBody, TrueSurface
from palpate.truth.tissue import true_tissue
from palpate_models.frames import Array, inverse, matrix
from palpate_models.load import true_pose
from palpate_models.motion import BodyMotion
from palpate_models.scenario import Scenario

PERIOD_S: Final = 0.010
"""Between two readings of the force, as of an examination's states."""
_LIFT_MPS: Final = 0.12


class NoTissueError(ValueError):
    """A scenario of whose tissue there is no copy. Names the field and what is allowed."""


@dataclass(frozen=True, eq=False)
class Touch:
    """What an indenter felt at n instants, PERIOD_S apart."""

    time: Array
    """Since the patient was first there [s], shape (n,)."""
    position: Array
    """Points of the skin at rest under the indenter [m], shape (n, 3), in A."""
    depth: Array
    """How far the indenter's lowest point is below the skin at rest, at the end of expiration [m], shape (n,)."""
    force: Array
    """Along the outward normal [N], shape (n,)."""


class Patient:
    """A patient and an indenter. Equal scenarios and equal motions give equal forces."""

    def __init__(self, scenario: Scenario, time: float = 0.0) -> None:
        """The patient of a scenario at `time` [s] of his breathing, untouched.

        Raises NoTissueError where there is no copy of his tissue.
        """
        tissue = true_tissue(scenario)
        if tissue is None:
            raise NoTissueError(
                f"{scenario.name}: services.tissue = {scenario.services.tissue!r} cannot be pressed without a run; "
                "want one of winkler, elastic, fmu, or a file whose service is a TissueService"
            )
        self.scenario = scenario
        self.tissue = tissue.in_steps_of(PERIOD_S)
        """The true tissue."""
        self.time = time
        """[s]"""
        self.radius = scenario.robot.indenter_radius_m
        """Of the indenter [m]."""
        self.X_WA: Array = matrix(true_pose(scenario))
        """Where he truly lies, shape (4, 4)."""
        self._motion = BodyMotion(scenario.phantom.motion, scenario.seed)
        self._steps = max(1, round(PERIOD_S / self.tissue.dt))
        self._ticks = round(time / PERIOD_S)
        self._p: Array | None = None

    @cached_property
    def surface(self) -> TrueSurface:
        """His skin at rest, at the end of expiration."""
        model = self.tissue.model
        return TrueSurface(TrueBody(model.vertices, model.triangles, self.X_WA))

    def stiffness(self, xy: Array) -> Array:
        """True foundation modulus k_w [N/m^3] at points [m], shape (p, 2) -> (p,); NaN off the body."""
        return np.asarray(self.surface.between(self.tissue.model.stiffness)(xy))

    def press(self, xy: Sequence[float] | Array, depth: float, speed: float, hold: float) -> Touch:
        """Presses at a place, along the inward normal, to `depth` [m] at `speed` [m/s], holds for `hold` [s], and lets go.

        Returns what was felt from the touch to the end of the hold. Raises ValueError for a place off the body.
        """
        down = _ramp(0.0, depth, speed)
        depths = np.concatenate((down, np.full(round(hold / PERIOD_S), depth)))
        return self._touch(np.tile(np.asarray(xy, dtype=float), (len(depths), 1)), depths)

    def slide(self, path: Sequence[Sequence[float]] | Array, depth: float, speed: float) -> Touch:
        """Presses at the start of a path as `press` does, slides along it at `depth` [m], and lets go at its end.

        `path`: corners [m], shape (k, 2), joined by straight lines, followed at `speed` [m/s] over the xy plane. Returns what
        was felt from the touch to the end of the path. Raises ValueError for a path that leaves the body.
        """
        corners = np.asarray(path, dtype=float).reshape(-1, 2)
        length = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))))
        down = _ramp(0.0, depth, speed)
        along = _ramp(0.0, float(length[-1]), speed)
        way = np.concatenate((np.zeros(len(down)), along))
        depths = np.concatenate((down, np.full(len(along), depth)))
        return self._touch(np.column_stack([np.interp(way, length, corners[:, k]) for k in (0, 1)]), depths)

    def rest(self, duration: float) -> None:
        """Nobody touches him for `duration` [s]."""
        self._p = None
        for _ in range(round(duration / PERIOD_S)):
            self._tick()
            for k in range(1, self._steps + 1):
                self.tissue.idle(self.time - PERIOD_S * (1 - k / self._steps))

    def move(self, p: Array) -> Array:
        """Moves the sphere's centre straight to `p` [m], shape (3,), in A as he lay at first, within PERIOD_S.

        Returns the mean force on the sphere meanwhile [N], shape (3,). After a rest it begins there.
        """
        self._tick()
        if self._motion.moves and self.time > self._motion.at_s:
            X = inverse(self._motion.pose(self.time))
            p = X[:3, :3] @ p + X[:3, 3]
        before = p if self._p is None else self._p
        way = p - before
        velocity, self._p = way / PERIOD_S, p
        if self._steps == 1:
            force, _ = self.tissue.step(self.time, p, velocity, self.radius)
            return self._turned(force)
        total = np.zeros(3)
        for k in range(1, self._steps + 1):
            share = k / self._steps
            total += self.tissue.step(self.time - PERIOD_S * (1 - share), before + share * way, velocity, self.radius)[0]
        return self._turned(total / self._steps)

    def _tick(self) -> None:
        self._ticks += 1
        self.time = self._ticks * PERIOD_S

    def _turned(self, force: Array) -> Array:
        """A force in the body's axes as it is in those of A."""
        moved = self._motion.moves and self.time > self._motion.at_s
        return np.asarray(self._motion.pose(self.time)[:3, :3] @ force) if moved else force

    def _touch(self, xy: Array, depths: Array) -> Touch:
        places, normals = self.surface.points(xy)
        off = ~np.isfinite(places).all(axis=1)
        if off.any():
            raise ValueError(f"({xy[off][0, 0]:g}, {xy[off][0, 1]:g}) m is off the body: want metres from the umbilicus")
        times, force = np.empty(len(xy)), np.empty(len(xy))
        for k, (place, normal, depth) in enumerate(zip(places, normals, depths, strict=True)):
            force[k] = self.move(place + (self.radius - depth) * normal) @ normal
            times[k] = self.time
        for height in _ramp(-float(depths[-1]), 0.0, _LIFT_MPS):
            self.move(places[-1] + (self.radius + height) * normals[-1])
        self._p = None
        return Touch(times, places, depths, force)


def _ramp(begin: float, end: float, speed: float) -> Array:
    """From `begin`, left out, to `end` at `speed`, a value each PERIOD_S; shape (n,)."""
    count = int(np.ceil(abs(end - begin) / (speed * PERIOD_S) - 1e-9))
    way = np.minimum(np.arange(1, count + 1) * speed * PERIOD_S, abs(end - begin))
    return np.asarray(begin + np.sign(end - begin) * way)
