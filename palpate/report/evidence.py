"""Collected messages as arrays, for scores, report and figures."""

from collections.abc import Iterable
from math import hypot
from operator import attrgetter
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from palpate.report.scoring import Map, Truth
from palpate.truth.pressed import Felt, Pressed, Touched, TrueBody, TrueSurface
from palpate_bus.messages import NS, StiffnessMap, nanoseconds
from palpate_bus.messages.geometry import pose_matrix
from palpate_models.numerics.frames import Array, apply, inverse
from palpate_models.patient.motion import BodyMotion
from palpate_models.scenario.load import exam_input
from palpate_models.scenario.schema import Scenario

xyz: Final = attrgetter("x", "y", "z")
"""Coordinates of a point or vector of a message."""


def columns_of(rows: Iterable[tuple[Any, ...]], kinds: np.dtype[Any]) -> dict[str, NDArray[Any]]:
    """Return an array for each field of `kinds`, without holding all rows in memory."""
    table = np.fromiter(rows, kinds)
    return {name: np.ascontiguousarray(table[name]) for name in kinds.names or ()}


def points(message: Any, field: str = "vertices") -> Array:
    """Return a flat array of a message as points, shape (n, 3)."""
    return np.asarray(getattr(message, field), dtype=np.float64).reshape(-1, 3)


def body_of(message: Any) -> TrueBody:
    """Return the body of a `palpation_msgs/PhantomTruth`."""
    triangles = np.asarray(message.surface.triangles, dtype=np.int32).reshape(-1, 3)
    return TrueBody(points(message.surface), triangles, pose_matrix(message.pose))


def felt_truth(scenario: Scenario, body: TrueBody, pressed: Pressed, touched: Touched) -> Truth:
    """Return the truth of a run whose patient was pressed."""
    felt = Felt(pressed, TrueSurface(body), scenario.exam)
    return Truth(body, felt, touched, np.array(exam_input(scenario).X_WA))


def map_of(message: Any) -> Map:
    """Return the map of a `palpation_msgs/StiffnessMap`; unassessed places do not count as scanned."""
    return Map(
        vertices=points(message),
        apparent=np.asarray(message.apparent, dtype=np.float64),
        lower=np.asarray(message.lower, dtype=np.float64),
        upper=np.asarray(message.upper, dtype=np.float64),
        scanned=np.asarray(message.scanned, dtype=bool) & (np.asarray(message.unassessed) == StiffnessMap.ASSESSED),
        finding=np.asarray(message.finding, dtype=np.int32),
    )


def unassessed_of(message: Any) -> dict[str, float]:
    """Return the scanned but unassessed area of the map by reason [m^2], without reasons that do not occur."""
    p, triangles = points(message), np.asarray(message.triangles, dtype=np.int64).reshape(-1, 3)
    a, b, c = (p[triangles[:, k]] for k in range(3))
    third = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 6
    area = np.bincount(triangles.ravel(), np.repeat(third, 3), minlength=len(p))
    codes = np.asarray(message.unassessed)
    reasons = {"contradicted": StiffnessMap.CONTRADICTED, "yielded": StiffnessMap.YIELDED}
    return {reason: float(area[codes == code].sum()) for reason, code in reasons.items() if (codes == code).any()}


def sample_columns(messages: Iterable[Any]) -> dict[str, NDArray[Any]]:
    """Return the columns of samples.csv, each of shape (m,), of m `palpation_msgs/PalpationSample`, in the abdomen frame."""
    return columns_of(
        (
            (nanoseconds(m.header.stamp) / NS, *xyz(m.position), *xyz(m.normal), m.depth, m.normal_force, m.tangential_speed,
             m.time_in_contact, m.depth_uncertainty, m.stroke, m.force_limited)
            for m in messages
        ),
        _SAMPLE,
    )  # fmt: skip


_SAMPLE: Final = np.dtype([
    *((name, "f8") for name in ("time_s", "x_m", "y_m", "z_m", "nx", "ny", "nz", "depth_m", "normal_force_N", "speed_mps",
                                "time_in_contact_s", "depth_uncertainty_m", "stroke")),
    ("force_limited", "?"),
])  # fmt: skip


def peak_force(message: Any) -> float:
    """Return the maximum contact force [N] since the previous `palpation_msgs/IndentationTruth`, including its current one."""
    return max(float(message.peak_force), hypot(message.normal_force, message.tangential_force))


def steady_contact(
    exam_states: Iterable[Any], indentation: Iterable[Any], X_WA: Array, motion: BodyMotion, registered_X_WA: Array
) -> Any:
    """Return measured and true contact at equal stamps while the contact is reported steady: `_CONTACT` records by time.

    Args:
        exam_states: `exam/state`; of several with one stamp the first counts.
        indentation: `truth/indentation`.
        X_WA: true pose of A in world at the start.
        motion: motion of the body from there.
        registered_X_WA: registered pose of A in world.
    """

    def shared(m: Any) -> tuple[Any, ...]:
        return nanoseconds(m.header.stamp), m.depth, xyz(m.surface_point)

    reported = columns_of(((*shared(s), s.depth_setpoint, s.force_limited) for s in exam_states if s.steady), _STEADY)
    true = columns_of(map(shared, indentation), _SHARED)
    stamps, at, truly = np.intersect1d(reported["stamp"], true["stamp"], return_indices=True)
    contact = np.zeros(len(stamps), _CONTACT).view(np.recarray)
    contact["measured"], contact["true"] = reported["depth"][at], true["depth"][truly]
    contact["wanted"], contact["limited"] = reported["wanted"][at], reported["limited"][at]
    contact["believed"] = apply(inverse(registered_X_WA), reported["place"][at])
    contact["touched"] = motion.on_body(stamps / NS, apply(inverse(X_WA), true["place"][truly]))
    return contact


_SHARED: Final = np.dtype([("stamp", "i8"), ("depth", "f8"), ("place", "f8", 3)])
_STEADY: Final = np.dtype([*_SHARED.descr, ("wanted", "f8"), ("limited", "?")])
_CONTACT: Final = np.dtype([
    *((name, "f8") for name in ("measured", "true", "wanted")), ("limited", "?"), ("believed", "f8", 3), ("touched", "f8", 3)
])  # fmt: skip
"""Measured, true and wanted depth [m]; whether depth yields to the force limit; estimated and true place on the rest surface
under the indenter [m], in the registered and in the true A."""
