"""Little-endian CDR of the states that several services read at 100 Hz, written out with `struct` as in `struct_codecs`."""

from __future__ import annotations

from struct import Struct

from palpate_bus.messages import ExamState, IndentationTruth, Point, SupervisorState, Vector3
from palpate_bus.messages.cdr import LENGTH, StructCodec, pack_header, pack_text, padding, read_header, read_text

_PHASE = Struct("<B")
_COUNTS = Struct("<III????")  # target index and count, targets skipped; in contact, steady, force limited, view blocked
_EXAM = Struct("<3d3d3dq2dI?")
# depth set-point, depth, force; surface point, surface normal; end tick; uncertainty, wall displacement, stroke, patient moved
_LEVEL = Struct("<BB")  # level, cause
_SUPERVISOR = Struct("<3dI")  # force, depth, speed; refusals
_INDENTATION = Struct("<4dI4x3dd")  # depth, normal, tangential and peak force; contacts; surface point, stiffness


def encode_exam_state(message: ExamState) -> bytes:
    """`palpation_msgs/ExamState`."""
    data = pack_header(message.header, 1) + _PHASE.pack(message.phase)
    data += bytes(padding(len(data), 4)) + pack_text(message.message)
    data += bytes(padding(len(data), 4)) + _COUNTS.pack(
        message.target_index, message.target_count, message.targets_skipped,
        message.in_contact, message.steady, message.force_limited, message.view_blocked,
    )  # fmt: skip
    p, n = message.surface_point, message.surface_normal
    return data + bytes(padding(len(data), 8)) + _EXAM.pack(
        message.depth_setpoint, message.depth, message.normal_force, p.x, p.y, p.z, n.x, n.y, n.z, message.end_tick,
        message.depth_uncertainty, message.wall_displacement, message.stroke, message.patient_moved,
    )  # fmt: skip


def decode_exam_state(data: bytes) -> tuple[ExamState, int]:
    """`palpation_msgs/ExamState`."""
    header, place = read_header(data, 1)
    (phase,) = _PHASE.unpack_from(data, place)
    text, place = read_text(data, place + _PHASE.size)
    place += padding(place, 4)
    index, count, skipped, touching, steady, force_limited, blocked = _COUNTS.unpack_from(data, place)
    place += _COUNTS.size
    place += padding(place, 8)
    setpoint, depth, force, px, py, pz, nx, ny, nz, *rest = _EXAM.unpack_from(data, place)
    message = ExamState(
        header, phase, text, index, count, skipped, touching, steady, force_limited, blocked,
        setpoint, depth, force, Point(px, py, pz), Vector3(nx, ny, nz), *rest,
    )  # fmt: skip
    return message, place + _EXAM.size


def encode_supervisor_state(message: SupervisorState) -> bytes:
    """`palpation_msgs/SupervisorState`."""
    data = pack_header(message.header, 1) + _LEVEL.pack(message.level, message.cause)
    data += bytes(padding(len(data), 4)) + pack_text(message.reason)
    data += bytes(padding(len(data), 4)) + LENGTH.pack(message.releases)
    measured = _SUPERVISOR.pack(message.force, message.depth, message.speed, message.refusals)
    return data + bytes(padding(len(data), 8)) + measured


def decode_supervisor_state(data: bytes) -> tuple[SupervisorState, int]:
    """`palpation_msgs/SupervisorState`."""
    header, place = read_header(data, 1)
    level, cause = _LEVEL.unpack_from(data, place)
    reason, place = read_text(data, place + _LEVEL.size)
    place += padding(place, 4)
    (releases,) = LENGTH.unpack_from(data, place)
    place += LENGTH.size
    place += padding(place, 8)
    force, depth, speed, refusals = _SUPERVISOR.unpack_from(data, place)
    return SupervisorState(header, level, cause, reason, releases, force, depth, speed, refusals), place + _SUPERVISOR.size


def encode_indentation_truth(message: IndentationTruth) -> bytes:
    """`palpation_msgs/IndentationTruth`."""
    p = message.surface_point
    return pack_header(message.header, 8) + _INDENTATION.pack(
        message.depth, message.normal_force, message.tangential_force, message.peak_force,
        message.contacts, p.x, p.y, p.z, message.stiffness,
    )  # fmt: skip


def decode_indentation_truth(data: bytes) -> tuple[IndentationTruth, int]:
    """`palpation_msgs/IndentationTruth`."""
    header, start = read_header(data, 8)
    depth, normal, tangential, peak, contacts, px, py, pz, stiffness = _INDENTATION.unpack_from(data, start)
    message = IndentationTruth(header, depth, normal, tangential, peak, contacts, Point(px, py, pz), stiffness)
    return message, start + _INDENTATION.size


EXAM_CODECS: dict[str, StructCodec] = {
    "palpation_msgs/msg/ExamState": StructCodec(encode_exam_state, decode_exam_state),
    "palpation_msgs/msg/IndentationTruth": StructCodec(encode_indentation_truth, decode_indentation_truth),
    "palpation_msgs/msg/SupervisorState": StructCodec(encode_supervisor_state, decode_supervisor_state),
}
