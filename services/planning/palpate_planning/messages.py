"""Messages of the examination from arrays, and arrays from the messages of perception."""

import numpy as np

from palpate_bus.messages import ExamState, Message, Path, PoseStamped, SkinTouch, SurfaceCorrection, SurfaceMotion
from palpate_bus.messages.geometry import mesh_arrays, point_message, pose_message, vector_message, vectors
from palpate_bus.messages.stamps import header, nanoseconds
from palpate_models.numerics.frames import Array
from palpate_planning.contact import ContactMeasurement
from palpate_planning.status import ExamStatus
from palpate_planning.strokes.plan import PerceivedAbdomen
from palpate_planning.wall.breath import HIDDEN_M, BreathObservation
from palpate_planning.wall.surface import PerceivedSurface
from palpate_planning.wall.wall import PublishedTouch

COINCIDENT_M = 1e-4
"""Consecutive targets closer than this have no path between them."""


def state_message(t: int, status: ExamStatus, contact: ContactMeasurement | None) -> Message:
    """Return `palpation_msgs/ExamState`; without a contact (before the first reading of the robot) nothing is measured."""
    p, n = (np.zeros(3), np.array((0.0, 0.0, 1.0))) if contact is None else contact.wall_point
    fields = {name: value for name, value in vars(status).items() if name not in ("phase", "cause")}
    return ExamState(
        header=header(t, "world"),
        phase=int(status.phase),
        reason=int(status.cause.reason),
        culprit=status.cause.culprit,
        in_contact=contact is not None and contact.touching,
        depth=0.0 if contact is None else contact.depth,
        normal_force=0.0 if contact is None else contact.force,
        surface_point=point_message(p),
        surface_normal=vector_message(n),
        depth_uncertainty=0.0 if contact is None else contact.wall.sigma,
        wall_displacement=0.0 if contact is None else contact.wall.displacement,
        **fields,
    )


def touch_message(t: int, touch: PublishedTouch) -> Message:
    """Return `palpation_msgs/SkinTouch` of a touch at `t` [ns]."""
    point = point_message(touch.p_W)
    return SkinTouch(header(t, "world"), point, touch.stroke, touch.height, touch.sigma, touch.expected, touch.expected_sigma)


def correction_message(t: int, outward: Array, sigma: Array) -> Message:
    """Return the `palpation_msgs/SurfaceCorrection` at `t` [ns]: outward offset and its SD [m] at each vertex, shapes (n,)."""
    return SurfaceCorrection(header(t, "abdomen"), outward.astype(np.float32), sigma.astype(np.float32))


def path_message(t: int, poses_WI: Array) -> Message:
    """Return the `nav_msgs/Path` at `t` [ns] of indenter poses X_WI, shape (n, 4, 4)."""
    return Path(header(t, "world"), [PoseStamped(header(t, "world"), pose_message(X[:3, :3], X[:3, 3])) for X in poses_WI])


def abdomen_of(mesh: Message, targets: Message, X_WA: Array) -> PerceivedAbdomen:
    """Return surface and targets of perception; `X_WA`, shape (4, 4). Raises ValueError if the messages cannot be used."""
    count, lines = len(targets.positions), np.asarray(targets.lines, dtype=np.int64)
    if len(lines) != count:
        raise ValueError(f"perception/targets: {len(lines)} lines for {count} positions")
    positions = vectors(targets.positions)
    coincident = np.flatnonzero(np.linalg.norm(np.diff(positions, axis=0), axis=1) < COINCIDENT_M)
    if len(coincident):
        raise ValueError(f"perception/targets: {coincident[0]} and {coincident[0] + 1} coincide")
    try:
        vertices, normals, triangles, breathing = mesh_arrays(mesh)
        if triangles.max(initial=-1) >= len(vertices):
            raise ValueError(f"triangles of vertex {triangles.max()}, it has {len(vertices)}")
        surface = PerceivedSurface.from_mesh(vertices, normals, X_WA, breathing)
    except ValueError as error:
        raise ValueError(f"perception/surface: {error}") from error
    return PerceivedAbdomen(positions, lines, vertices, triangles, surface)


def motion_of(message: Message) -> BreathObservation:
    """Return the motion in a `palpation_msgs/SurfaceMotion`. While the wall is hidden the forecast is used if it is certain."""
    seen = bool(message.state != SurfaceMotion.LOST)
    calm = message.state == SurfaceMotion.QUIET or (not seen and message.uncertainty < HIDDEN_M)
    moved = bool(message.state == SurfaceMotion.MOVED)
    shift = (float(message.shift.x), float(message.shift.y))
    return BreathObservation(
        nanoseconds(message.header.stamp), np.asarray(message.forecast), float(message.uncertainty), calm, moved, shift, seen
    )
