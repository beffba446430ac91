"""Contacts of a table of probes, which has no time."""

import numpy as np

from palpate.recording import cutting
from palpate.recording.faults import Fault, FaultCode, Remedy
from palpate.recording.motion import Axis, noise
from palpate.recording.readings import Readings
from palpate.recording.recording import Contact, ContactKind, Palpated, width
from palpate.recording.skin import fit_skin, grid_over
from palpate.recording.timed import implausible_unit, normal_force

_AWAY = 3.0
"""A probe that goes this many times as far as the usual one, or so far aside, has jumped."""
_TOUCHED = 3.0
"""Minimum force of a contact, in SD of the force."""
_DISORDER = 2.5
"""Way of a probe's rows, over its depth, that is not one press and its retreat."""
_MANY = 50
"""Contacts whose places and normals are the skin."""
_DOUBT = 0.2
"""Largest uncertainty of a position at first contact that is given, over the travel of a probe."""
_UNTARED = 0.5
"""Force at first contact, over that of the probe, that light contact does not have."""


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
        return Palpated.nothing()
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
        return Palpated.nothing()
    if normals is not None and len(points) >= _MANY and width(points) > reach:
        at = np.array([contact.normal[0] for contact in contacts])
        return Palpated(contacts, points, at, power, len(kept) - len(contacts))
    skin = fit_skin(points, np.full(len(points), max(scatter, 1e-5)), grid_over(points[:, :2], reach), 2 * reach)
    return Palpated(contacts, *skin.points(), power, len(kept) - len(contacts))
