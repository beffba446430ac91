"""Contacts of a recording, measured from the skin where they begin.

A recording over time is aligned, tared and cut. A table of probes has no time: each probe is a contact.
The unpressed skin is a smooth height field through the places where contacts begin, as a Gaussian process.
"""

from collections.abc import Sequence
from dataclasses import replace
from enum import Enum, auto
from functools import partial
from pathlib import Path
from typing import Final, NamedTuple
from warnings import catch_warnings

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import LinearNDInterpolator, NearestNDInterpolator, RectBivariateSpline, make_interp_spline
from scipy.linalg import cho_solve
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel
from threadpoolctl import threadpool_limits

from palpate.recording import cutting
from palpate.recording.cutting import ContactOnset, across
from palpate.recording.mapping import SCALES, Mapping
from palpate.recording.motion import TUNING, Axis, delay, delay_force, free_air, noise, tare
from palpate.recording.readings import Readings
from palpate.recording.recording import Contact, ContactKind, Fault, FaultCode, Palpated, Remedy, is_refused, width
from palpate_errors import UserError, restate
from palpate_models.numerics.frames import Array, apply, inverse, path_length
from palpate_models.patient.mesh import read_mesh, vertex_normals

_TRAVEL: Final = (0.005, 4.0)
"""Plausible travel of a contact along the normal, in radii of the tool."""
_DELAY_S: Final = 0.04
"""Delay that is reported and corrected."""
_DRIFT: Final = 0.05
"""Drift that is reported, as a share of the usual force."""
_FOLLOWS: Final = 0.1
"""SD of the depth over itself, of a slide that keeps it."""
_MOVES: Final = 2.0
"""Distance of slides from one skin, in these SD, from which the body moved."""
_AWAY: Final = 3.0
"""A probe that goes this many times as far as the usual one, or so far aside, has jumped."""
_TOUCHED: Final = 3.0
"""Minimum force of a contact, in SD of the force."""
_DISORDER: Final = 2.5
"""Way of a probe's rows, over its depth, that is not one press and its retreat."""
_MANY: Final = 50
"""Contacts whose places and normals are the skin."""
_DOUBT: Final = 0.2
"""Largest uncertainty of a position at first contact that is given, over the travel of a probe."""
_UNTARED: Final = 0.5
"""Force at first contact, over that of the probe, that light contact does not have."""


def normal_force(force: Array, normal: Array) -> Array:
    """Return the force along the outward normal [N], shape (n,); `force` (n, 3), or (n, 1) if it is that already."""
    return force[:, 0] if force.shape[1] == 1 else np.asarray((force * normal).sum(axis=-1))


def implausible_unit(travel: float, radius: float) -> list[Fault]:
    """Return the fault of lengths in another unit; `travel` of a contact and `radius` of the tool [m]."""
    low, high = _TRAVEL
    return [] if low * radius < travel < high * radius else [Fault(FaultCode.UNIT, 1, 1, Remedy.REFUSED, travel)]


def contacts_over_time(readings: Readings, axis: Axis, mapping: Mapping, X_WA: Array, faults: list[Fault]) -> Palpated:
    """Return the contacts of readings in A, and the skin; adds faults."""
    readings, sigma = _prepare(readings, axis, mapping, faults)
    assert readings.time is not None
    height, force = readings.position @ axis.outward, normal_force(readings.force, axis.outward)
    found = cutting.cut(readings.time, height, force, sigma)
    if not found.touching:
        faults.append(Fault(FaultCode.NOTHING, 1, 1, Remedy.REFUSED))
        return Palpated()
    if found.blind:
        faults.append(Fault(FaultCode.NO_CONTACT, found.blind, found.blind + len(found.touching), Remedy.LEFT_OUT))
    span = float(np.median([np.ptp(height[one]) for one in found.touching]))
    faults += implausible_unit(span, mapping.tool.radius_m)
    work = _Measured(readings, axis.outward, mapping.tool.radius_m, sigma, found.touching, span)
    if mapping.body.surface is not None:
        scale = SCALES[mapping.units.length]
        work.skin = of_mesh(mapping.body.surface, scale, inverse(X_WA), mapping.tool.radius_m, work.stations)
    return work.palpation(faults)


def _prepare(readings: Readings, axis: Axis, mapping: Mapping, faults: list[Fault]) -> tuple[Readings, float]:
    """Return the readings with force and position aligned and the force tared, and the SD of the force [N]."""
    assert readings.time is not None
    time = readings.time
    if mapping.force.delay_s:
        readings = delay_force(readings, mapping.force.delay_s)
    late = delay(time, readings.position @ axis.outward, normal_force(readings.force, axis.outward))
    if abs(late) > max(_DELAY_S, 2 * float(np.median(np.diff(time)))):
        faults.append(Fault(FaultCode.CLOCK, 1, 1, Remedy.CORRECTED, late))
        readings = delay_force(readings, late)
    height, force = readings.position @ axis.outward, normal_force(readings.force, axis.outward)
    if not mapping.force.tare:
        return readings, max(noise(force), 1e-4)
    free = free_air(time, height, force, axis.stiffness)
    if not free.any():
        faults.append(Fault(FaultCode.NO_FREE_AIR, 1, 1, Remedy.NOT_TARED))
        return readings, max(noise(force), 1e-4)
    level, drift, spread = tare(time, readings.force, free)
    sigma = float(spread.max())
    pressed = normal_force(level, axis.outward)
    pressed = pressed[pressed > TUNING.sigmas * sigma]
    if len(pressed) and np.abs(drift).max() > max(_DRIFT * float(np.median(pressed)), 2 * sigma):
        faults.append(Fault(FaultCode.DRIFT, 1, 1, Remedy.CORRECTED, float(np.abs(drift).max())))
    return replace(readings, force=level), sigma


class _Motion(Enum):
    PRESS = auto()
    SLIDE = auto()
    CYCLE = auto()
    """Part of a slide that pushes in and out, which is a press of its own."""


class _Loading(NamedTuple):
    """The first part of a contact, whole cycles of a slide, or another stretch of one, along one normal."""

    normal: Array
    inward: Array
    """[m], shape (k,)."""
    force: Array
    """[N]"""
    at: Array
    """A position in it [m], shape (3,): its end, or its mean."""
    at_inward: float
    """Inward coordinate there [m]."""
    along: Array | None = None
    """Coordinate along the path of cycles [m], 0 at `at`, shape (k,)."""

    @property
    def loaded(self) -> cutting.Loaded:
        """Its values, as the onset is sought in them."""
        return (self.inward, self.force) if self.along is None else (self.inward, self.force, self.along)


class _Measured:
    """Contacts and skin of readings in A, each found from the other."""

    def __init__(
        self, readings: Readings, outward: Array, radius: float, sigma: float, touching: list[slice], span: float
    ) -> None:
        self.readings, self.outward, self.radius, self.sigma = readings, outward, radius, sigma
        p = readings.position
        self.reach = float(np.sqrt(radius * min(span, radius)))
        """Radius of the footprint [m]."""
        self.stations = grid_over(np.concatenate([p[one, :2] for one in touching]), self.reach)
        self.touching: list[tuple[slice, _Motion]] = []
        for one in touching:
            if cutting.lateral_travel(p[one], outward) <= self.reach:
                self.touching.append((one, _Motion.PRESS))
                continue
            force = normal_force(readings.force[one], outward)
            parts = cutting.cycles(across(p[one], outward), -(p[one] @ outward), force, radius)
            cycles = [slice(one.start + part.start, one.start + part.stop) for part in parts]
            self.touching += [(part, _Motion.CYCLE) for part in cycles] or [(one, _Motion.SLIDE)]
        self.skin: RecordedSkin | None = None
        self.power = 1.0

    def palpation(self, faults: list[Fault]) -> Palpated:
        """Return the contacts and the skin; adds a fault."""
        given = self.skin is not None
        for _ in range(2):  # the second time with the normals of the first
            loads = [self._loading(*one) for one in self.touching]
            self.power = cutting.power_of([load.loaded for load in loads], self.sigma)
            onsets = [cutting.onset(load.loaded, self.power, self.sigma) for load in loads]
            kept = self._slide_depths(loads, onsets)
            points, sd = self._skin_points(loads, onsets, kept)
            if not len(points):
                return Palpated(untold=len(self.touching))
            if not given:
                self.skin = fit_skin(points, sd, self.stations, 2 * self.reach)
        assert self.skin is not None
        if given:
            self.skin, kept = self.skin.through(points, sd), {}
        begun = sum(begin is not None for begin in onsets)
        off = (points[:, 2] - self.skin.at(points[:, :2])[0])[begun:]
        if (
            kept
            and len(off)
            and not is_refused(faults)
            and (apart := float(np.sqrt(np.mean(off**2)))) > _MOVES * float(sd[begun:].mean())
        ):
            faults.append(Fault(FaultCode.MOVES, 1, 1, Remedy.ONE_DEPTH, apart))
            kept = dict.fromkeys(kept, float(np.median(list(kept.values()))))
            self.skin = fit_skin(*self._skin_points(loads, onsets, kept), self.stations, 2 * self.reach)
        contacts: list[Contact] = []
        for k, ((one, motion), load, begin) in enumerate(zip(self.touching, loads, onsets, strict=True)):
            if motion is _Motion.SLIDE:
                contacts += self._slid(one, kept.get(k))
            elif begin is not None and self.readings.whole[one].any():
                contacts.append(self._contact(one, load, begin))
        surface = partial(self.skin.surface, radius=self.radius, margin=self.reach)
        return Palpated(contacts, surface, self.power, len(self.touching) - len(contacts))

    def _slide_depths(self, loads: list[_Loading], onsets: list[ContactOnset | None]) -> dict[int, float]:
        """Return the depth that each slide is taken to keep [m]: as it began, or the usual one if that is unlike it."""
        slides = [k for k, (_, motion) in enumerate(self.touching) if motion is _Motion.SLIDE]
        begun = {k: loads[k].at_inward - begin.at if (begin := onsets[k]) else 0.0 for k in slides}
        deep = [depth for depth in begun.values() if depth > 0]
        usual = float(np.median(deep)) if deep else 0.0
        return {k: depth if 0.5 * usual < depth < 2 * usual else usual for k, depth in begun.items()} if deep else {}

    def _loading(self, one: slice, motion: _Motion) -> _Loading:
        p = self.readings.position[one]
        normal = self.outward if self.skin is None else self.skin.at(p[:1, :2])[1][0]
        inward, whole = -(p @ normal), self.readings.whole[one]
        if motion is _Motion.CYCLE:
            middle, along = p.mean(axis=0), path_length(across(p, normal))
            force = normal_force(self.readings.force[one], normal)
            return _Loading(normal, inward[whole], force[whole], middle, float(inward.mean()), (along - along.mean())[whole])
        force = normal_force(self.readings.force[one], normal)
        if motion is _Motion.SLIDE:
            still = np.linalg.norm(across(p - p[0], normal), axis=1) < 0.5 * self.reach
            p, inward = p[: max(3, int(np.argmin(still)))], inward[: max(3, int(np.argmin(still)))]
        down = cutting.loading(inward)
        if motion is _Motion.SLIDE:  # before it slides it may be held, while the force relaxes or the body moves
            down = slice(0, max(3, min(down.stop, cutting.loading(force[: len(p)]).stop)))
        whole = whole[: len(p)][down]
        return _Loading(normal, inward[down][whole], force[: len(p)][down][whole], p[down][-1], float(inward[down][-1]))

    def _skin_points(
        self, loads: list[_Loading], onsets: list[ContactOnset | None], kept: dict[int, float]
    ) -> tuple[Array, Array]:
        """Return points that the tool's centre has at first contact [m], shape (n, 3), and their SD [m].

        They are of onsets; and after these, with less weight, of the stretches of slides that keep a depth [m].
        """
        begun = [(load, begin) for load, begin in zip(loads, onsets, strict=True) if begin is not None]
        points = [load.at + (load.at_inward - begin.at) * load.normal for load, begin in begun]
        sd = [begin.sd for _, begin in begun]
        for k, depth in kept.items():
            p = self._sliding(self.touching[k][0])[0]
            normals = np.tile(self.outward, (len(p), 1)) if self.skin is None else self.skin.at(p[:, :2])[1]
            for part in cutting.windows(across(p, self.outward), self.reach):
                points.append(p[part].mean(axis=0) + depth * normals[part].mean(axis=0))
                sd.append(_FOLLOWS * depth)
        return np.array(points).reshape(-1, 3), np.array(sd)

    def _sliding(self, one: slice) -> tuple[Array, Array, Array]:
        """Return position, force and time of a slide without its descent and lift."""
        p = self.readings.position[one]
        near = cutting.FOOTPRINT_SHARE * self.reach
        begun, ended = (np.linalg.norm(across(p - end, self.outward), axis=1) > near for end in (p[0], p[-1]))
        moving = np.arange(len(p)) >= int(np.argmax(begun))
        moving[len(p) - int(np.argmax(ended[::-1])) :] = False
        moving &= self.readings.whole[one]
        return p[moving], self.readings.force[one][moving], self._time(one)[moving]

    def _contact(self, one: slice, load: _Loading, begin: ContactOnset) -> Contact:
        p = self.readings.position[one]
        cycle = load.along is not None
        kept = slice(None) if cycle else cutting.before_lift(-(p @ load.normal))
        whole = self.readings.whole[one][kept]
        p, F, time = p[kept][whole], self.readings.force[one][kept][whole], self._time(one)[kept][whole]
        depth = -(p @ load.normal) - begin.at - (0.0 if load.along is None else begin.slope * load.along)
        return Contact(
            kind=ContactKind.PRESS,
            position=p + np.outer(depth - self.radius, load.normal),
            normal=np.tile(load.normal, (len(p), 1)),
            depth=depth,
            force=normal_force(F, load.normal),
            depth_uncertainty=begin.sd,
            force_noise=self.sigma,
            time=time,
        )

    def _slid(self, one: slice, kept: float | None) -> list[Contact]:
        """Return the part of a slide that is at depth; none if that is too short.

        It keeps the depth `kept` [m] but for what is too short for the body's shape; if None, the skin shows the depth.
        """
        assert self.skin is not None
        p, F, time = self._sliding(one)
        z, normal, sd = self.skin.at(p[:, :2])
        parts = cutting.windows(across(p, self.outward), self.reach)
        if kept is not None and len(parts) > 1:
            way = path_length(across(p, self.outward))
            path = make_interp_spline([way[part].mean() for part in parts], [p[part, 2].mean() for part in parts], k=1)
            z, sd = path(way) + kept / normal[:, 2], np.full(len(p), _FOLLOWS * kept)
        depth = (z - p[:, 2]) * normal[:, 2]
        deep = np.flatnonzero(depth > 0.5 * np.median(depth))
        if len(deep) < 3:
            return []
        first = p + depth[:, None] * normal
        first[:, 2] = self.skin.at(first[:, :2])[0]  # its own heights would be those of a body that moves
        return [
            Contact(
                kind=ContactKind.SLIDE,
                position=(first - self.radius * normal)[deep],
                normal=normal[deep],
                depth=depth[deep],
                force=normal_force(F, normal)[deep],
                depth_uncertainty=float(np.median(sd[deep])),
                force_noise=self.sigma,
                time=time[deep],
            )
        ]

    def _time(self, one: slice) -> NDArray[np.float64]:
        assert self.readings.time is not None
        return self.readings.time[one]


def probes(readings: Readings) -> list[slice]:
    """Return the rows of each probe."""
    assert readings.probe is not None
    ends = np.flatnonzero(np.diff(readings.probe)) + 1
    return [slice(int(a), int(b)) for a, b in zip((0, *ends), (*ends, len(readings.probe)), strict=True)]


def contacts_of_probes(readings: Readings, axis: Axis, radius: float, rows: list[slice], faults: list[Fault]) -> Palpated:
    """Return the contacts of readings in A, and the skin; adds faults."""
    p, normals = readings.position.copy(), readings.normal
    n = np.tile(axis.outward, (len(p), 1)) if normals is None else normals
    force = normal_force(readings.force, n)
    heights = [p[one] @ n[one][0] for one in rows]
    disordered = [np.abs(np.diff(z)).sum() > _DISORDER * np.ptp(z) for z in heights]
    if np.mean(disordered) > 0.5:
        faults.append(Fault(FaultCode.ORDER, int(np.sum(disordered)), len(rows), Remedy.CORRECTED))
        for one, z in zip(rows, heights, strict=True):
            order = np.argsort(-z)
            p[one], force[one] = p[one][order], force[one][order]
    start = p if readings.touch is None else readings.touch
    travel = np.array([float(np.ptp(p[one] @ n[one][0])) for one in rows])
    aside = np.array([float(np.linalg.norm(p[one] - start[one][0], axis=1).max()) for one in rows])
    usual = float(np.median(travel))
    faults += implausible_unit(usual, radius)
    sigma = max(float(np.median([noise(force[one]) for one in rows])), 1e-4)
    jumped = aside > max(_AWAY * usual, 1e-9)
    empty = ~jumped & np.array([force[one].max() < _TOUCHED * sigma for one in rows])
    for code, wrong, value in ((FaultCode.JUMP, jumped, aside), (FaultCode.NO_CONTACT, empty, force)):
        if wrong.any():
            faults.append(Fault(code, int(wrong.sum()), len(rows), Remedy.LEFT_OUT, float(value.max())))
    kept = [one for one, wrong in zip(rows, jumped | empty, strict=True) if not wrong]
    if not kept:
        return Palpated()
    inward = [-(p[one] @ n[one][0]) for one in kept]
    begin_at = [-(start[one][0] @ n[one][0]) for one in kept]
    given = readings.touch is not None
    light = [force[one][0] for one, s, at in zip(kept, inward, begin_at, strict=True) if s[0] - at < 0.1 * (s.max() - at)]
    if given and len(light) > 0.5 * len(kept):
        zero, usual_peak = float(np.median(light)), float(np.median([force[one].max() for one in kept]))
        if abs(zero) > _UNTARED * (usual_peak - zero):
            faults.append(Fault(FaultCode.ZERO, len(kept), len(rows), Remedy.CORRECTED, zero))
            force = force - zero
    loads = [(s[d], force[one][d]) for s, one in zip(inward, kept, strict=True) if (d := cutting.loading(s))]
    power = cutting.power_of(loads, sigma)
    onsets = [cutting.onset(load, power, sigma) for load in loads]
    off = np.array([begin.at - at if begin else np.nan for begin, at in zip(onsets, begin_at, strict=True)])
    scatter = 1.4826 * float(np.nanmedian(np.abs(off - np.nanmedian(off)))) if np.isfinite(off).any() else 0.0
    contacts = []
    for one, s, at, begin in zip(kept, inward, begin_at, onsets, strict=True):
        if begin is None and not given:
            continue
        sd = min(scatter, _DOUBT * usual) if given or begin is None else begin.sd
        down = slice(one.start, one.start + cutting.before_lift(s).stop)
        depth = (s - (at if given or begin is None else begin.at))[: down.stop - down.start]
        place = p[down] + (depth - radius)[:, None] * n[down]
        contacts.append(Contact(ContactKind.PROBE, place, n[down], depth, force[down], sd, sigma))
    points = np.array([contact.position[0] for contact in contacts]).reshape(-1, 3)
    reach = float(np.sqrt(radius * usual))
    if not contacts:
        return Palpated()
    if normals is not None and len(points) >= _MANY and width(points) > reach:
        return Palpated(contacts, _first_touched, power, len(kept) - len(contacts))
    skin = fit_skin(points, np.full(len(points), max(scatter, 1e-5)), grid_over(points[:, :2], reach), 2 * reach)
    return Palpated(contacts, partial(skin.surface, radius=0.0, margin=reach), power, len(kept) - len(contacts))


def _first_touched(contacts: Sequence[Contact]) -> tuple[Array, Array]:
    return np.array([contact.position[0] for contact in contacts]), np.array([contact.normal[0] for contact in contacts])


_MOST: Final = 300
"""Points that the process is fitted to."""
_NODES: Final = 40
"""Nodes of its grid along the longer side."""
_OUTLIERS: Final = 3
"""Times that points are given less weight, which are this many SD off the skin through the others:"""
_STRANGE: Final = 4.0
_NARROW: Final = 0.1
"""Minimum RMS width of the points, over the shortest length of the skin, over which it has a slope."""
_PLANE: Final = 4
"""Minimum number of points that a plane is fitted to."""


class RecordedSkin(NamedTuple):
    """Heights of the tool's centre at first contact over the xy plane of A, on a grid."""

    x: Array
    y: Array
    """[m]"""
    z: Array
    """[m], shape (nx, ny)."""
    sd: Array
    """[m], shape (nx, ny)."""

    def at(self, xy: Array) -> tuple[Array, Array, Array]:
        """Return height [m] (k,), outward unit normal (k, 3) and SD of the height [m] (k,) at places [m], shape (k, 2)."""
        surface = RectBivariateSpline(self.x, self.y, self.z, kx=3, ky=3)
        slope = np.column_stack((surface.ev(xy[:, 0], xy[:, 1], dx=1), surface.ev(xy[:, 0], xy[:, 1], dy=1)))
        normal = np.column_stack((-slope, np.ones(len(xy))))
        spread = RectBivariateSpline(self.x, self.y, self.sd, kx=1, ky=1).ev(*xy.T)
        return surface.ev(*xy.T), normal / np.linalg.norm(normal, axis=1)[:, None], spread

    def surface(self, contacts: Sequence[Contact], *, radius: float, margin: float) -> tuple[Array, Array]:
        """Return points of the skin [m], `radius` below these, over contacts and a margin, and its normals, shape (n, 3) each."""
        stations = grid_over(np.concatenate([contact.position[:, :2] for contact in contacts]), margin)
        xy = np.stack(np.meshgrid(*stations, indexing="ij"), axis=-1).reshape(-1, 2)
        z, normal, _ = self.at(xy)
        return np.column_stack((xy, z)) - radius * normal, normal

    def through(self, points: Array, sd: Array) -> "RecordedSkin":
        """Return the skin moved outward or inward to points of standard deviation `sd` [m], by their weighted mean."""
        off = points[:, 2] - self.at(points[:, :2])[0]
        near = np.abs(off - np.median(off)) <= 5 * np.median(np.abs(off - np.median(off))) + 1e-9
        return self._replace(z=self.z + float(np.average(off[near], weights=sd[near] ** -2)))


def of_mesh(file: Path, scale: float, X_AW: Array, radius: float, stations: tuple[Array, Array]) -> RecordedSkin:
    """Return the skin of a mesh in the frame of the positions, in units of `scale` [m]. Raises UserError."""
    with restate(UserError, UserError, f"body.surface = {file}"):
        vertices, triangles = read_mesh(file)
    centres = apply(X_AW, scale * vertices)
    centres += radius * vertex_normals(centres, triangles)
    xy = np.stack(np.meshgrid(*stations, indexing="ij"), axis=-1)
    z = LinearNDInterpolator(centres[:, :2], centres[:, 2])(xy)
    z = np.where(np.isfinite(z), z, NearestNDInterpolator(centres[:, :2], centres[:, 2])(xy))
    return RecordedSkin(*stations, z, np.full(z.shape, 0.0))


def grid_over(xy: Array, margin: float) -> tuple[Array, Array]:
    """Return the stations in x and y of a grid over places [m], shape (n, 2), and a margin [m]."""
    low, high = xy.min(axis=0) - margin, xy.max(axis=0) + margin
    step = float((high - low).max()) / _NODES
    x, y = (np.linspace(a, b, max(5, round((b - a) / step) + 1)) for a, b in zip(low, high, strict=True))
    return x, y


def fit_skin(points: Array, sd: Array, stations: tuple[Array, Array], shortest: float) -> RecordedSkin:
    """Return the skin through points [m], shape (n, 3), of standard deviation `sd` [m], shape (n,).

    `shortest`: shortest length over which the skin varies [m].
    """
    chosen = np.argsort(sd, kind="stable")[:: max(1, len(sd) // _MOST)]
    points, sd = points[chosen], sd[chosen]
    centre = points.mean(axis=0)
    terms = 3 if len(points) >= _PLANE else 1
    sloping = _terms(points, centre, terms) / sd[:, None]
    # a line shows no slope across it
    plane = np.linalg.lstsq(sloping, (points[:, 2] - centre[2]) / sd, rcond=_NARROW * shortest)[0]
    rest = points[:, 2] - centre[2] - _terms(points, centre, terms) @ plane
    size = max(float(np.sqrt(np.mean(rest**2))), float(np.median(sd)), 1e-6)
    extent = float(np.ptp(points[:, :2], axis=0).max()) + shortest
    noise = (sd / size) ** 2
    smooth = ConstantKernel(1.0, (0.05, 1e3)) * RBF(max(shortest, 0.5 * extent), (shortest, 10 * extent))
    process = GaussianProcessRegressor(smooth + WhiteKernel(0.05, (1e-4, 1.0)), alpha=noise)
    with threadpool_limits(1), catch_warnings(action="ignore"):  # the best length may be at its bound
        process.fit(points[:, :2], rest / size)
        for _ in range(_OUTLIERS):
            precision = np.diag(cho_solve((process.L_, True), np.eye(len(points))))
            off = process.alpha_ / precision  # of each point from the skin through the others
            strange = np.abs(off) * np.sqrt(precision) > _STRANGE
            if not strange.any():
                break
            noise = np.where(strange, np.maximum(noise, off**2), noise)
            process = GaussianProcessRegressor(process.kernel_, alpha=noise, optimizer=None).fit(points[:, :2], rest / size)
    x, y = stations
    xy = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
    mean, spread = process.predict(xy, return_std=True)
    z = centre[2] + _terms(xy, centre, terms) @ plane + size * mean
    known = np.sqrt(np.maximum(spread**2 - process.kernel_.k2.noise_level, 0.0))  # of the skin, not of a point of it
    return RecordedSkin(x, y, z.reshape(len(x), len(y)), (size * known).reshape(len(x), len(y)))


def _terms(places: Array, centre: Array, count: int) -> Array:
    """Return the terms of a plane, or of a level, at places [m], shape (n, count)."""
    return np.column_stack((np.ones(len(places)), *(places[:, k] - centre[k] for k in (0, 1))))[:, :count]
