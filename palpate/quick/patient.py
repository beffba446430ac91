"""The true tissue of a scenario, pressed by an indenter without an arm.

    >>> patient = Patient("person", seed=7)
    >>> touch = patient.press((0.03, -0.02), depth=0.010, speed=0.02, hold=0.5)
    >>> touch.force.shape, bool(touch.force.max() > 1.0)
    ((100,), True)

Positions are in the true abdomen frame A: x to the patient's left, y to the head, z outward, from the umbilicus. The patient
breathes and guards as in the scenario, and lies still; earlier presses have lasting effects. The indenter follows the breath as
`exam.breathing` says.
"""

from collections.abc import Callable, Sequence
from functools import cached_property
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from palpate.apart import run_guarded
from palpate.truth.pressed import TrueBody, TrueSurface, true_tissue
from palpate_bus.implementations import kind
from palpate_bus.settings import Settings
from palpate_errors import UserError
from palpate_models.numerics.frames import Array, Mask, matrix
from palpate_models.scenario.load import ScenarioError, restrict_to_view, true_pose, whole_scenario
from palpate_models.scenario.patterns import stations
from palpate_models.scenario.schema import Exam, Following, Scenario
from palpate_perception.pipeline import PIPELINE
from palpate_planning.interruptions import WALL
from palpate_plugins import PluginError

PERIOD_S: Final = 0.010
"""Period of the force readings, as of exam/state."""
_LIFT_MPS: Final = 0.12
_LONGEST_HOLD_S: Final = 60.0


class NoTissueError(UserError):
    """The tissue of the scenario has no copy that can be pressed. Names the field and the allowed values."""


class Seen(NamedTuple):
    """A patient as seen before the first touch, without the truth inside."""

    scenario: Scenario
    """Scenario as given to the roles of the examination: without the patient, the seed and the errors of the equipment."""
    places: Array
    """Points of the skin at rest over the examined region [m], shape (n, 3), in A."""
    normals: Array
    """Outward unit normals there, shape (n, 3)."""


class Touch(NamedTuple):
    """Measurements of an indenter at n instants, PERIOD_S apart."""

    time: Array
    """Time of the patient [s], shape (n,)."""
    position: Array
    """Points of the skin at rest under the indenter [m], shape (n, 3), in A."""
    normal: Array
    """Outward unit normals there, shape (n, 3)."""
    depth: Array
    """Depth of the indenter's lowest point below the unpressed skin [m], shape (n,): the breathing skin, or with
    `exam.breathing: ignore` the skin at the end of expiration."""
    force: Array
    """Along the outward normal [N], shape (n,)."""
    steady: Mask
    """True at the requested depth, shape (n,); with `exam.breathing: gate` only within a millimetre of the end of expiration."""
    seen: Seen
    """The patient as seen."""

    def __repr__(self) -> str:
        (x, y, _), seconds = self.position[0], PERIOD_S * len(self.time)
        deepest, highest = 1e3 * self.depth.max(), self.force.max()
        return f"Touch({len(self.time)} instants in {seconds:.2f} s from ({x:.3f}, {y:.3f}) m, {deepest:.1f} mm, {highest:.1f} N)"


class Patient:
    """A patient who lies still, and an indenter. Equal scenarios and presses give equal forces."""

    def __init__(self, scenario: str | Path | Scenario, seed: int | None = None, *, time: float = 0.0) -> None:
        """Build the patient of a scenario (name, YAML file or object), untouched, at `time` [s].

        `seed` replaces that of a scenario given by name or file. Raises ScenarioError for an invalid scenario and for a patient
        who moves, MeshError for a body that cannot be built, NoTissueError for a tissue without a copy.
        """
        scenario = whole_scenario(scenario, seed)
        if (moves := scenario.phantom.motion.kind) != "none":
            raise ScenarioError(
                f"{scenario.name}: phantom.motion.kind = {moves!r}: expected none, for palpate.Patient and tier: quick press a "
                "patient who lies still; palpate run and tier: whole examine one who moves"
            )
        choice = scenario.services.tissue
        if kind("tissue").foreign(choice):
            part = f"services.tissue = {choice!r}"
            run_guarded(part, lambda: _try_tissue(scenario), Settings.read().start_limit_s, PluginError)
        tissue = true_tissue(scenario)
        if tissue is None:
            raise NoTissueError(
                f"{scenario.name}: services.tissue = {scenario.services.tissue!r} cannot be pressed without a run; "
                "expected winkler, elastic, fmu without tissue.fmu and tissue.fmu_map, or a file whose service is a TissueService"
            )
        self.scenario = scenario
        self.tissue = tissue.in_steps_of(PERIOD_S)
        """The true tissue."""
        self.time = time
        """[s]"""
        self.radius = scenario.robot.indenter_radius_m
        """Radius of the indenter [m]."""
        self.X_WA: Array = matrix(true_pose(scenario))
        """True pose, shape (4, 4)."""
        self._steps = max(1, round(PERIOD_S / self.tissue.dt))
        self._ticks = round(time / PERIOD_S)
        self._p: Array | None = None

    @cached_property
    def surface(self) -> TrueSurface:
        """The skin at rest, at the end of expiration."""
        model = self.tissue.model
        return TrueSurface(TrueBody(model.vertices, model.triangles, self.X_WA))

    @cached_property
    def seen(self) -> Seen:
        """The patient as seen before the first touch: the true skin at rest."""
        places, normals = self.surface.points(seen_lattice(self.scenario.exam))
        there = np.isfinite(places).all(axis=1)
        return Seen(restrict_to_view(self.scenario, "exam"), places[there], normals[there])

    @cached_property
    def _follows(self) -> Callable[[Array], Array]:
        """Fraction of the breathing excursion that the indenter follows at points [m], shape (n, 2) -> (n,)."""
        share = self.tissue.model.breathing
        return self.surface.between(np.zeros_like(share) if self.scenario.exam.breathing is Following.IGNORE else share)

    def stiffness(self, xy: Array) -> Array:
        """Return the true foundation modulus k_w [N/m^3] at points [m], shape (p, 2) -> (p,); NaN off the body."""
        return np.asarray(self.surface.between(self.tissue.model.stiffness)(xy))

    def press(self, xy: Sequence[float] | Array, depth: float, speed: float, hold: float) -> Touch:
        """Press at a place, along the inward normal, to `depth` [m] at `speed` [m/s], hold for `hold` [s], and lift.

        Depth and speed are relative to the breathing skin; with `exam.breathing: ignore` to the skin at the end of expiration.
        `xy`: metres from the umbilicus, shape (2,). Returns the measurements from the touch to the end of the hold. Raises
        ValueError for a place off the body, and for a depth or speed beyond the scenario's `limits`.
        """
        self._within_limits(depth, speed)
        if not 0 <= hold <= _LONGEST_HOLD_S:
            raise ValueError(f"hold = {hold} s: expected 0 to {_LONGEST_HOLD_S:g} s")
        down = _ramp(0.0, depth, speed)
        depths = np.concatenate((down, np.full(round(hold / PERIOD_S), depth)))
        return self._touch(np.tile(_corners([xy], "xy"), (len(depths), 1)), depths, len(down))

    def slide(self, path: Sequence[Sequence[float]] | Array, depth: float, speed: float) -> Touch:
        """Press at the start of a path as `press` does, slide along it at `depth` [m], and lift at its end.

        `path`: corners [m], shape (k, 2), joined by straight lines, followed at `speed` [m/s] over the xy plane. Returns the
        measurements from the touch to the end of the path. Raises ValueError as `press` does, and if the path leaves the body.
        """
        self._within_limits(depth, speed)
        corners = _corners(path, "path")
        length = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))))
        down = _ramp(0.0, depth, speed)
        along = _ramp(0.0, float(length[-1]), speed)
        way = np.concatenate((np.zeros(len(down)), along))
        depths = np.concatenate((down, np.full(len(along), depth)))
        return self._touch(np.column_stack([np.interp(way, length, corners[:, k]) for k in (0, 1)]), depths, len(down))

    def rest(self, duration: float) -> None:
        """Leave the patient untouched for `duration` [s]."""
        self._p = None
        for _ in range(round(duration / PERIOD_S)):
            self._tick()
            for k in range(1, self._steps + 1):
                self.tissue.idle(self.time - PERIOD_S * (1 - k / self._steps))

    def move(self, p: Array) -> Array:
        """Move the sphere's centre straight to `p` [m], shape (3,), within PERIOD_S.

        Returns the mean force on the sphere during this time [N], shape (3,). After a rest the sphere begins at `p`. Raises
        PluginError if a tissue of a user's file wants to end the program.
        """
        try:
            return self._pressed_force(p)
        except SystemExit as left:
            raise kind("tissue").failure(self.scenario.services.tissue, left) from left

    def _pressed_force(self, p: Array) -> Array:
        self._tick()
        before = p if self._p is None else self._p
        way = p - before
        velocity, self._p = way / PERIOD_S, p
        if self._steps == 1:
            return self.tissue.step(self.time, p, velocity, self.radius)[0]
        total = np.zeros(3)
        for k in range(1, self._steps + 1):
            share = k / self._steps
            total += self.tissue.step(self.time - PERIOD_S * (1 - share), before + share * way, velocity, self.radius)[0]
        return np.asarray(total / self._steps)

    def _tick(self) -> None:
        self._ticks += 1
        self.time = self._ticks * PERIOD_S

    def _within_limits(self, depth: float, speed: float) -> None:
        limits = self.scenario.limits
        for name, value, high, unit in (("depth", depth, limits.depth_m, "m"), ("speed", speed, limits.contact_speed_mps, "m/s")):
            if not 0 < value <= high:
                raise ValueError(f"{name} = {value} {unit}: expected above 0, at most {high:g} {unit} (limits of the scenario)")

    def _touch(self, xy: Array, depths: Array, descent: int) -> Touch:
        """`descent`: number of instants of the descent."""
        places, normals = self.surface.points(xy)
        off = ~np.isfinite(places).all(axis=1)
        if off.any():
            raise ValueError(f"({xy[off][0, 0]:g}, {xy[off][0, 1]:g}) m is off the body: expected metres from the umbilicus")
        shares = self._follows(xy)
        times, force, lifted = np.empty(len(xy)), np.empty(len(xy)), np.empty(len(xy))
        for k, (place, normal, depth, share) in enumerate(zip(places, normals, depths, shares, strict=True)):
            lifted[k] = share * self.tissue.excursion(self.time + PERIOD_S)
            force[k] = self.move(place + (self.radius - depth + lifted[k]) * normal) @ normal
            times[k] = self.time
        for height in _ramp(-float(depths[-1]), 0.0, _LIFT_MPS):
            up = shares[-1] * self.tissue.excursion(self.time + PERIOD_S)
            self.move(places[-1] + (self.radius + height + up) * normals[-1])
        self._p = None
        there = np.arange(len(depths)) >= descent
        if self.scenario.exam.breathing is Following.GATE:
            there &= np.abs(lifted) < WALL.gate_m
        return Touch(times, places, normals, depths, force, there, self.seen)


def _try_tissue(scenario: Scenario) -> None:
    """Make the tissue of a user's file and step it once, without contact."""
    tissue = true_tissue(scenario)
    if tissue is not None:
        tissue.in_steps_of(PERIOD_S).step(0.0, np.array((0.0, 0.0, 1.0)), np.zeros(3), scenario.robot.indenter_radius_m)


def seen_lattice(exam: Exam) -> Array:
    """Return points of the perceived mesh: over the region and a margin [m], shape (n, 2)."""
    x, y = (
        stations(centre, size + 2 * PIPELINE.mesh_margin_m, PIPELINE.mesh_step_m)
        for centre, size in zip(exam.centre_m, exam.region_m, strict=True)
    )
    return np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)


def _corners(path: Sequence[Sequence[float] | Array] | Array, name: str) -> Array:
    """Return places [m], shape (k, 2), k at least 1."""
    corners = np.asarray(path, dtype=float)
    if corners.ndim != 2 or corners.shape[1:] != (2,) or not np.isfinite(corners).all() or not len(corners):
        raise ValueError(f"{name} = {path}: expected x and y [m] in the abdomen frame for each place")
    return corners


def _ramp(begin: float, end: float, speed: float) -> Array:
    """Return values from `begin` (excluded) to `end` at `speed`, one per PERIOD_S, shape (n,)."""
    count = int(np.ceil(abs(end - begin) / (speed * PERIOD_S) - 1e-9))
    way = np.minimum(np.arange(1, count + 1) * speed * PERIOD_S, abs(end - begin))
    return np.asarray(begin + np.sign(end - begin) * way)
