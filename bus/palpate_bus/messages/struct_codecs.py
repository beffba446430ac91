"""Little-endian CDR of the 1 kHz messages with `struct`. `codec` uses rosbags for all others.

CDR aligns each number to its own size, counted from the end of the four-byte encapsulation. All these types start with a
header, whose `frame_id` has any length; the rest is aligned after it and has a fixed layout. Encoders and decoders raise any
exception for unsuitable fields or bytes; `codec` converts it to CodecError. A decoder returns the message and its end.
"""

from collections.abc import Callable
from functools import lru_cache
from struct import Struct
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from palpate_bus.messages import (
    Duration,
    Header,
    JointState,
    JointTorqueCommand,
    Point,
    Pose,
    Quaternion,
    Time,
    ToolState,
    Twist,
    Vector3,
    Wrench,
    WrenchStamped,
)

ENCAPSULATION = b"\x00\x01\x00\x00"
"""The first four bytes of little-endian CDR."""
LENGTH = Struct("<I")
"""Length of a sequence, or of a string in bytes with its NUL."""
_STAMP = Struct("<4siI")  # encapsulation, seconds, nanoseconds
_HEADER = Struct("<4siII")  # the same and the length of frame_id with its NUL


class StructCodec(NamedTuple):
    """Encoder and decoder of one message type."""

    encode: Callable[[Any], bytes]
    decode: Callable[[bytes], tuple[Any, int]]


def padding(position: int, size: int) -> int:
    """Return the padding from `position`, encapsulation included, to the alignment of a number of `size` bytes."""
    return (4 - position) % size


def pack_header(header: Header, align: int) -> bytes:
    """Return encapsulation and header, padded for a number of `align` bytes."""
    return _STAMP.pack(ENCAPSULATION, header.stamp.sec, header.stamp.nanosec) + _pack_frame(header.frame_id, align)


@lru_cache(maxsize=64)
def _pack_frame(frame_id: str, align: int) -> bytes:
    """Return the header after its stamp, padded for a number of `align` bytes. Cached: there are few frames."""
    frame = frame_id.encode() + b"\0"
    return LENGTH.pack(len(frame)) + frame + bytes(padding(_HEADER.size + len(frame), align))


def read_header(data: bytes, align: int) -> tuple[Header, int]:
    """Return the header and the position of the next number of `align` bytes."""
    _, sec, nanosec, length = _HEADER.unpack_from(data)
    frame, start = _read_frame(data[_STAMP.size : _HEADER.size + length], align)
    return Header(Time(sec, nanosec), frame), start


@lru_cache(maxsize=64)
def _read_frame(block: bytes, align: int) -> tuple[str, int]:
    """Return the frame in `block` (length and text) and the position of the next number of `align` bytes."""
    (length,) = LENGTH.unpack_from(block)
    frame, end = read_characters(block, LENGTH.size, length)
    end += _STAMP.size
    return frame, end + padding(end, align)


def read_text(data: bytes, place: int) -> tuple[str, int]:
    """Return the string at the next four-byte boundary from `place`, and its end."""
    start = place + padding(place, 4)
    (length,) = LENGTH.unpack_from(data, start)
    return read_characters(data, start + LENGTH.size, length)


def read_characters(data: bytes, start: int, length: int) -> tuple[str, int]:
    """Return the string of `length` bytes, NUL included, at `start`, and its end."""
    end = start + length
    if length < 1 or end > len(data) or data[end - 1]:
        raise ValueError(f"invalid string of length {length} at {start}")
    return data[start : end - 1].decode(), end


def pack_text(text: str) -> bytes:
    """Return a string as CDR; it must start at a four-byte boundary."""
    data = text.encode() + b"\0"
    return LENGTH.pack(len(data)) + data


_FLOAT64 = np.dtype(np.float64)

_DURATION = Struct("<iI")
_WRENCH = Struct("<6d")  # force, torque
_TOOL = Struct("<3d4d6dd")  # position, orientation, twist, radius


@lru_cache(maxsize=64)
def _numbers(count: int, start: int) -> Struct:
    """Return the layout of a sequence of `count` float64 from `start` on."""
    gap = padding(start + LENGTH.size, 8) if count else 0
    return Struct(f"<I{gap}x{8 * count}s")


@lru_cache(maxsize=64)
def _joints(count: int, gap: int) -> Struct:
    """Return the layout of position, velocity and effort of `count` joints, the first of which follow a gap of `gap` bytes."""
    return Struct(f"<I{gap}x{8 * count}sI4x{8 * count}sI4x{8 * count}s")


def fit(value: Any, dtype: np.dtype[Any], length: int | None, field: str) -> NDArray[Any]:
    """Return `value` as a contiguous array of `dtype`, shape (length,), or of any length if that is None.

    Raises ValueError that names the field for another shape, or for an unsafe conversion (text, complex numbers, fractions for an
    integer field).
    """
    array: NDArray[Any]
    if value.__class__ is np.ndarray and value.dtype == dtype and value.flags.c_contiguous:
        array = value
    else:
        array = np.asarray(value)
        if not (np.can_cast(array.dtype, dtype, "same_kind") or array.size == 0):
            raise ValueError(f"{field}: has {array.dtype}, expected {dtype}")
        array = np.ascontiguousarray(array, dtype) if array.ndim else array
    if array.ndim != 1 or (length is not None and array.size != length):
        raise ValueError(f"{field}: has shape {array.shape}, expected ({'n' if length is None else length},)")
    return array


def encode_wrench_stamped(message: WrenchStamped) -> bytes:
    """Encode `geometry_msgs/WrenchStamped` as CDR."""
    force, torque = message.wrench.force, message.wrench.torque
    return pack_header(message.header, 8) + _WRENCH.pack(force.x, force.y, force.z, torque.x, torque.y, torque.z)


def decode_wrench_stamped(data: bytes) -> tuple[WrenchStamped, int]:
    """Decode `geometry_msgs/WrenchStamped` from CDR."""
    header, start = read_header(data, 8)
    fx, fy, fz, tx, ty, tz = _WRENCH.unpack_from(data, start)
    return WrenchStamped(header, Wrench(Vector3(fx, fy, fz), Vector3(tx, ty, tz))), start + _WRENCH.size


def encode_tool_state(message: ToolState) -> bytes:
    """Encode `palpation_msgs/ToolState` as CDR."""
    p, q = message.pose.position, message.pose.orientation
    v, w = message.twist.linear, message.twist.angular
    return pack_header(message.header, 8) + _TOOL.pack(
        p.x, p.y, p.z, q.x, q.y, q.z, q.w, v.x, v.y, v.z, w.x, w.y, w.z, message.radius
    )  # fmt: skip


def decode_tool_state(data: bytes) -> tuple[ToolState, int]:
    """Decode `palpation_msgs/ToolState` from CDR."""
    header, start = read_header(data, 8)
    px, py, pz, qx, qy, qz, qw, vx, vy, vz, wx, wy, wz, radius = _TOOL.unpack_from(data, start)
    pose = Pose(Point(px, py, pz), Quaternion(qx, qy, qz, qw))
    return ToolState(header, pose, Twist(Vector3(vx, vy, vz), Vector3(wx, wy, wz)), radius), start + _TOOL.size


def encode_joint_torque_command(message: JointTorqueCommand) -> bytes:
    """Encode `palpation_msgs/JointTorqueCommand` as CDR."""
    data = pack_header(message.header, 4)
    for field in ("torque", "position"):
        values = fit(getattr(message, field), _FLOAT64, None, field)
        data += _numbers(values.size, len(data)).pack(values.size, values.tobytes())
    valid_for = message.valid_for
    return data + _DURATION.pack(valid_for.sec, valid_for.nanosec) + _pack_texts((message.problem, message.culprit))


@lru_cache(maxsize=64)
def _pack_texts(texts: tuple[str, ...]) -> bytes:
    """Return strings, from a four-byte boundary to the end of the last."""
    data = b""
    for text in texts:
        data += bytes(-len(data) % 4) + pack_text(text)
    return data


def decode_joint_torque_command(data: bytes) -> tuple[JointTorqueCommand, int]:
    """Decode `palpation_msgs/JointTorqueCommand` from CDR."""
    header, start = read_header(data, 4)
    torque, start = _read_array(data, start)
    position, start = _read_array(data, start)
    sec, nanosec = _DURATION.unpack_from(data, start)
    problem, end = read_text(data, start + _DURATION.size)
    culprit, end = read_text(data, end)
    return JointTorqueCommand(header, torque, position, Duration(sec, nanosec), problem, culprit), end


def encode_joint_state(message: JointState) -> bytes:
    """Encode `sensor_msgs/JointState` as CDR."""
    data = pack_header(message.header, 4) + _pack_names(tuple(message.name))
    position = fit(message.position, _FLOAT64, None, "position")
    velocity = fit(message.velocity, _FLOAT64, None, "velocity")
    effort = fit(message.effort, _FLOAT64, None, "effort")
    n = position.size
    if n == velocity.size == effort.size > 0:
        joints = _joints(n, padding(len(data) + LENGTH.size, 8))
        return data + joints.pack(n, position.tobytes(), n, velocity.tobytes(), n, effort.tobytes())
    for values in (position, velocity, effort):
        data += _numbers(values.size, len(data)).pack(values.size, values.tobytes())
    return data


def decode_joint_state(data: bytes) -> tuple[JointState, int]:
    """Decode `sensor_msgs/JointState` from CDR."""
    header, start = read_header(data, 4)
    names, start = _read_names(data, start)
    joints = _joints(len(names), padding(start + LENGTH.size, 8))
    if names and len(data) - start == joints.size:
        n, q, n_qd, qd, n_effort, effort = joints.unpack_from(data, start)
        if n == n_qd == n_effort == len(names):
            state = JointState(header, names, np.frombuffer(q), np.frombuffer(qd), np.frombuffer(effort))
            return state, len(data)
    position, start = _read_array(data, start)
    velocity, start = _read_array(data, start)
    effort, end = _read_array(data, start)
    return JointState(header, names, position, velocity, effort), end


@lru_cache(maxsize=64)
def _pack_names(names: tuple[str, ...]) -> bytes:
    """Return a sequence of strings, from one four-byte boundary to another."""
    data = bytearray(LENGTH.pack(len(names)))
    for name in names:
        data += pack_text(name)
        data += bytes(-len(data) % 4)
    return bytes(data)


class _NamesReader:
    """Reads a sequence of strings. Joint names rarely change, so the previous bytes and names are cached."""

    def __init__(self) -> None:
        self._last: tuple[bytes, list[str]] = (b"", [])

    def __call__(self, data: bytes, start: int) -> tuple[list[str], int]:
        """Return the strings of the sequence at `start`, and the position of the next four-byte number."""
        block, last_names = self._last
        if block and data.startswith(block, start):
            return last_names.copy(), start + len(block)
        (count,) = LENGTH.unpack_from(data, start)
        position = start + LENGTH.size
        names = []
        for _ in range(count):
            name, end = read_text(data, position)
            names.append(name)
            position = end + padding(end, 4)
        if position <= len(data):
            self._last = data[start:position], names.copy()
        return names, position


_read_names = _NamesReader()


def _read_array(data: bytes, start: int) -> tuple[NDArray[np.float64], int]:
    """Return the float64 sequence at `start`, and its end."""
    (count,) = LENGTH.unpack_from(data, start)
    begin = start + LENGTH.size
    if count:
        begin += padding(begin, 8)
    return np.frombuffer(data, _FLOAT64, count, begin), begin + 8 * count


STRUCT_CODECS: dict[str, StructCodec] = {
    "geometry_msgs/msg/WrenchStamped": StructCodec(encode_wrench_stamped, decode_wrench_stamped),
    "palpation_msgs/msg/JointTorqueCommand": StructCodec(encode_joint_torque_command, decode_joint_torque_command),
    "palpation_msgs/msg/ToolState": StructCodec(encode_tool_state, decode_tool_state),
    "sensor_msgs/msg/JointState": StructCodec(encode_joint_state, decode_joint_state),
}
