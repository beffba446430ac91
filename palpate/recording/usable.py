"""Checks contacts against each other and against their own uncertainty."""

from typing import Final

import numpy as np
from scipy.spatial import cKDTree

from palpate.recording.faults import Fault, FaultCode, Remedy
from palpate.recording.recording import Contact, ContactKind, force_at, width

_DISAGREE: Final = 0.35
"""Log ratio of forces at one place that is reported."""
_SURE: Final = 4.0
"""Least depth, in SD of its zero; least force, in SD of its noise."""
_LINE: Final = 0.1
"""Least width of the places, over the radius of the footprint, from which on there is a map."""
_SHARE: Final = 0.3
"""Least depth, as a share of the usual one."""


def usable(contacts: list[Contact], radius: float, undeep_ones: int, faults: list[Fault]) -> list[Contact]:
    """Return the contacts that can be assessed; adds faults. `undeep_ones`: contacts that are left out already."""
    depths = np.array([contact.depth.max() for contact in contacts])
    usual = float(np.median(depths)) if len(depths) else 0.0
    deep = [
        depth > max(_SURE * contact.depth_uncertainty, _SHARE * usual) and contact.force.max() > _SURE * contact.force_noise
        for contact, depth in zip(contacts, depths, strict=True)
    ]
    shallow = undeep_ones + len(contacts) - sum(deep)
    if shallow:
        faults.append(Fault(FaultCode.SHALLOW, shallow, undeep_ones + len(contacts), Remedy.LEFT_OUT))
    deep_ones = [contact for contact, enough in zip(contacts, deep, strict=True) if enough]
    wrong = _disagreeing(deep_ones, usual, radius)
    if wrong:
        faults.append(Fault(FaultCode.DISAGREE, len(wrong), len(deep_ones), Remedy.LEFT_OUT))
    good = [contact for k, contact in enumerate(deep_ones) if k not in wrong]
    if not good:
        return []
    places = np.concatenate([contact.position[0 if contact.kind is ContactKind.SLIDE else -1 :] for contact in good])
    wide = width(places) / float(np.sqrt(radius * usual))
    if wide < 1:
        faults.append(Fault(FaultCode.LINE, len(good), len(good), Remedy.KEPT if wide > _LINE else Remedy.REFUSED))
    return good if wide > _LINE else []


def _disagreeing(contacts: list[Contact], depth: float, radius: float) -> set[int]:
    """Return the contacts whose force differs from that of others at the same place: all of two, the odd ones of more."""
    still = [k for k, contact in enumerate(contacts) if contact.kind is not ContactKind.SLIDE]
    if len(still) < 2:
        return set()
    places = np.array([contacts[k].position[-1, :2] for k in still])
    force = np.log([max(force_at(contacts[k], depth)[0], 1e-9) for k in still])
    wrong: set[int] = set()
    for k, near in enumerate(cKDTree(places).query_ball_point(places, 0.3 * np.sqrt(radius * depth))):
        if len(near) > 1 and abs(force[k] - np.median(force[near])) > (_DISAGREE if len(near) > 2 else 0.5 * _DISAGREE):
            wrong.add(still[k])
    return wrong
