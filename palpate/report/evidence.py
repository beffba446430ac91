"""Collected messages as arrays, for scores, report and figures."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from math import hypot
from operator import attrgetter
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from palpate.report.scoring import Found, Map, Truth
from palpate.truth.felt import Felt
from palpate.truth.pressed import Pressed
from palpate.truth.surface import TrueBody, TrueSurface
from palpate.truth.touched import Touched
from palpate_bus.messages import StiffnessMap
from palpate_bus.messages.geometry import pose_matrix
from palpate_bus.messages.stamps import NS, nanoseconds
from palpate_models.numerics.frames import Array, apply, inverse
from palpate_models.patient.motion import BodyMotion
from palpate_models.scenario.load import exam_input
from palpate_models.scenario.schema import Scenario

Mask = NDArray[np.bool_]
xyz: Final = attrgetter("x", "y", "z")
"""Of a point or vector of a message."""


@dataclass(frozen=True)
class Samples:
    """The samples of a run, in A; m of them."""

    time: Array
    """[s], shape (m,)."""
    position: Array
    """[m], shape (m, 3)."""
    normal: Array
    """Shape (m, 3)."""
    depth: Array
    """[m]"""
    force: Array
    """[N]"""
    speed: Array
    """[m/s]"""
    time_in_contact: Array
    """[s]"""
    depth_uncertainty: Array
    """One sigma of the depth, as the examination tells it [m]."""
    stroke: Array
    """Number of the descent."""
    force_limited: Mask


@dataclass(frozen=True)
class ContactRecord:
    """Measured and true contact at equal stamps while the examination says it is steady; m instants."""

    measured: Array
    """Depth as the examination measures it [m]."""
    true: Array
    """True depth [m]."""
    wanted: Array
    """Depth set-point [m]."""
    force: Array
    """Measured normal force [N]."""
    touched: Touched
    """Rest surface points under the indenter."""
    limited: Mask
    """Depth yields to the force limit."""

    def then(self, later: ContactRecord) -> ContactRecord:
        """The record, and after it that of an examination that went on with this one."""
        both = {
            name: np.concatenate((getattr(self, name), getattr(later, name)))
            for name in ("measured", "true", "wanted", "force", "limited")
        }
        places = (np.concatenate((getattr(self.touched, k), getattr(later.touched, k))) for k in ("believed", "true"))
        return ContactRecord(**both, touched=Touched(*places))


def columns_of(rows: Iterable[tuple[Any, ...]], kinds: np.dtype[Any]) -> dict[str, NDArray[Any]]:
    """An array for each field of `kinds`. The rows are never in memory all at once."""
    table = np.fromiter(rows, kinds)
    return {name: np.ascontiguousarray(table[name]) for name in kinds.names or ()}


def points(message: Any, field: str = "vertices") -> Array:
    """A flat array of a message as points, shape (n, 3)."""
    return np.asarray(getattr(message, field), dtype=np.float64).reshape(-1, 3)


def body_of(message: Any) -> TrueBody:
    """`palpation_msgs/PhantomTruth`."""
    triangles = np.asarray(message.surface.triangles, dtype=np.int32).reshape(-1, 3)
    return TrueBody(points(message.surface), triangles, pose_matrix(message.pose))


def felt_truth(scenario: Scenario, body: TrueBody, pressed: Pressed, touched: Touched) -> Truth:
    """What is true of a run whose patient was pressed."""
    felt = Felt(pressed, TrueSurface(body), scenario.exam)
    return Truth(body, felt, touched, np.array(exam_input(scenario).X_WA))


def map_of(message: Any) -> Map:
    """`palpation_msgs/StiffnessMap`: where it says that it does not know, nothing counts as scanned."""
    return Map(
        vertices=points(message),
        apparent=np.asarray(message.apparent, dtype=np.float64),
        lower=np.asarray(message.lower, dtype=np.float64),
        upper=np.asarray(message.upper, dtype=np.float64),
        scanned=np.asarray(message.scanned, dtype=bool) & (np.asarray(message.unassessed) == StiffnessMap.ASSESSED),
        finding=np.asarray(message.finding, dtype=np.int32),
    )


def unassessed_of(message: Any) -> dict[str, float]:
    """Area of the map of which nothing is said although the arm was there, by reason [m^2]; only reasons that there are."""
    p, triangles = points(message), np.asarray(message.triangles, dtype=np.int64).reshape(-1, 3)
    a, b, c = (p[triangles[:, k]] for k in range(3))
    third = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 6
    area = np.bincount(triangles.ravel(), np.repeat(third, 3), minlength=len(p))
    codes = np.asarray(message.unassessed)
    reasons = {"contradicted": StiffnessMap.CONTRADICTED, "yielded": StiffnessMap.YIELDED}
    return {reason: float(area[codes == code].sum()) for reason, code in reasons.items() if (codes == code).any()}


def found_of(areas: Sequence[Any]) -> list[Found]:
    """Findings or candidates, each a `palpation_msgs/Finding`."""
    return [
        Found(np.array((f.centroid.x, f.centroid.y, f.centroid.z)), f.area, f.ratio, (f.ratio_lower, f.ratio_upper))
        for f in areas
    ]


def samples_of(messages: list[Any]) -> Samples:
    """`palpation_msgs/PalpationSample`, in order."""

    def column(values: list[Any], width: int = 0) -> Array:
        return np.array(values, dtype=np.float64).reshape((-1, width) if width else -1)

    return Samples(
        time=column([nanoseconds(m.header.stamp) / NS for m in messages]),
        position=column([(m.position.x, m.position.y, m.position.z) for m in messages], 3),
        normal=column([(m.normal.x, m.normal.y, m.normal.z) for m in messages], 3),
        depth=column([m.depth for m in messages]),
        force=column([m.normal_force for m in messages]),
        speed=column([m.tangential_speed for m in messages]),
        time_in_contact=column([m.time_in_contact for m in messages]),
        depth_uncertainty=column([m.depth_uncertainty for m in messages]),
        stroke=column([m.stroke for m in messages]),
        force_limited=np.array([m.force_limited for m in messages], dtype=bool),
    )


def peak_force(message: Any) -> float:
    """Greatest contact force [N] since the `palpation_msgs/IndentationTruth` before, at least that of its own moment."""
    return max(float(message.peak_force), hypot(message.normal_force, message.tangential_force))


def steady_contact(
    exam_states: Iterable[Any], indentation: Iterable[Any], X_WA: Array, motion: BodyMotion, registered_X_WA: Array
) -> ContactRecord:
    """Exam states that count, with the true contact at the same stamp, in order of time; of messages with one stamp the first.

    Poses of A in world: the true one at first, how the body moves from there, and the registered one.
    """

    def shared(m: Any) -> tuple[Any, ...]:
        return nanoseconds(m.header.stamp), m.depth, xyz(m.surface_point)

    told = columns_of(((*shared(s), s.depth_setpoint, s.normal_force, s.force_limited) for s in exam_states if s.steady), _STEADY)
    true = columns_of(map(shared, indentation), _SHARED)
    stamps, at, truly = np.intersect1d(told["stamp"], true["stamp"], return_indices=True)
    believed = apply(inverse(registered_X_WA), told["place"][at])
    touched = motion.on_body(stamps / NS, apply(inverse(X_WA), true["place"][truly]))
    return ContactRecord(
        measured=told["depth"][at],
        true=true["depth"][truly],
        wanted=told["wanted"][at],
        force=told["force"][at],
        touched=Touched(believed, touched),
        limited=told["limited"][at],
    )


_SHARED: Final = np.dtype([("stamp", "i8"), ("depth", "f8"), ("place", "f8", 3)])
_STEADY: Final = np.dtype([*_SHARED.descr, ("wanted", "f8"), ("force", "f8"), ("limited", "?")])
