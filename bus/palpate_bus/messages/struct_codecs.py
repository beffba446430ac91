"""Little-endian CDR of the messages of the control loop, written out with `struct`. `codec` uses rosbags for all others.

These are the types of the 1 kHz topics, and the two of the 100 Hz topics that cost rosbags most: set-point and robot status.

CDR aligns each number to its own size, counted from the end of the four-byte encapsulation. All these messages begin with a
header, whose `frame_id` has any length, so that what follows it is aligned anew and then has a fixed layout.

The encoders raise whatever goes wrong with a field, the decoders whatever goes wrong with the bytes; `codec` makes it a
CodecError. A decoder returns the message and the position of its end.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from struct import Struct
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from palpate_bus.messages import (
    Duration,
    Header,
    ImpedanceSetpoint,
    JointState,
    JointTorqueCommand,
    Point,
    Pose,
    Quaternion,
    RobotStatus,
    Time,
    ToolState,
    Twist,
    Vector3,
    Wrench,
    WrenchStamped,
)
from palpate_bus.messages.arrays import fitted

ENCAPSULATION = b"\x00\x01\x00\x00"
"""The first four bytes of little-endian CDR."""
_FLOAT64 = np.dtype(np.float64)

_BYTE = Struct("<B")
_LENGTH = Struct("<I")
_STAMP = Struct("<4siI")  # encapsulation, seconds, nanoseconds
_HEADER = Struct("<4siII")  # the same and the length of frame_id with its NUL
_WRENCH = Struct("<6d")  # force, torque
_TOOL = Struct("<3d4d6dd")  # position, orientation, twist, radius
_COMMAND = Struct("<56siII")  # torques, seconds and nanoseconds of valid_for, length of problem with its NUL
_SETPOINT = Struct("<3d4d6d6d48s48s56s56s56siI")  # pose, twist, wrench, gains [6] x 2, joints [7] x 3, valid_for
_JOINTS = {padding: Struct(f"<I{padding}x56sI4x56sI4x56s") for padding in (0, 4)}  # position, velocity, effort of seven joints
_STATUS = Struct("<56s56s6d56sI")  # position, velocity, wrench, applied torque, commands rejected


def _padding(position: int, size: int) -> int:
    """Bytes from `position`, encapsulation counted in, up to where a number of `size` bytes may stand."""
    return (4 - position) % size


def _pack_header(header: Header, align: int) -> bytes:
    """Encapsulation and header, padded for a number of `align` bytes."""
    return _STAMP.pack(ENCAPSULATION, header.stamp.sec, header.stamp.nanosec) + _pack_frame(header.frame_id, align)


@lru_cache(maxsize=64)
def _pack_frame(frame_id: str, align: int) -> bytes:
    """What follows the stamp of a header, padded for a number of `align` bytes. There are few frames."""
    frame = frame_id.encode() + b"\0"
    return _LENGTH.pack(len(frame)) + frame + bytes(_padding(_HEADER.size + len(frame), align))


def _read_header(data: bytes, align: int) -> tuple[Header, int]:
    """The header, and the position of the number of `align` bytes that follows."""
    _, sec, nanosec, length = _HEADER.unpack_from(data)
    frame, start = _read_frame(data[_STAMP.size : _HEADER.size + length], align)
    return Header(Time(sec, nanosec), frame), start


@lru_cache(maxsize=64)
def _read_frame(block: bytes, align: int) -> tuple[str, int]:
    """The frame whose length and text are `block`, and the position of the number of `align` bytes that follows the header."""
    (length,) = _LENGTH.unpack_from(block)
    frame, end = _read_text(block, _LENGTH.size, length)
    end += _STAMP.size
    return frame, end + _padding(end, align)


def _read_text(data: bytes, start: int, length: int) -> tuple[str, int]:
    """The string of `length` bytes with its NUL at `start`, and its end."""
    end = start + length
    if length < 1 or end > len(data) or data[end - 1]:
        raise ValueError(f"invalid string of length {length} at {start}")
    return data[start : end - 1].decode(), end


def encode_wrench_stamped(message: WrenchStamped) -> bytes:
    """`geometry_msgs/WrenchStamped`."""
    force, torque = message.wrench.force, message.wrench.torque
    return _pack_header(message.header, 8) + _WRENCH.pack(force.x, force.y, force.z, torque.x, torque.y, torque.z)


def decode_wrench_stamped(data: bytes) -> tuple[WrenchStamped, int]:
    """`geometry_msgs/WrenchStamped`."""
    header, start = _read_header(data, 8)
    fx, fy, fz, tx, ty, tz = _WRENCH.unpack_from(data, start)
    return WrenchStamped(header, Wrench(Vector3(fx, fy, fz), Vector3(tx, ty, tz))), start + _WRENCH.size


def encode_tool_state(message: ToolState) -> bytes:
    """`palpation_msgs/ToolState`."""
    p, q = message.pose.position, message.pose.orientation
    v, w = message.twist.linear, message.twist.angular
    return _pack_header(message.header, 8) + _TOOL.pack(
        p.x, p.y, p.z, q.x, q.y, q.z, q.w, v.x, v.y, v.z, w.x, w.y, w.z, message.radius
    )  # fmt: skip


def decode_tool_state(data: bytes) -> tuple[ToolState, int]:
    """`palpation_msgs/ToolState`."""
    header, start = _read_header(data, 8)
    px, py, pz, qx, qy, qz, qw, vx, vy, vz, wx, wy, wz, radius = _TOOL.unpack_from(data, start)
    pose = Pose(Point(px, py, pz), Quaternion(qx, qy, qz, qw))
    return ToolState(header, pose, Twist(Vector3(vx, vy, vz), Vector3(wx, wy, wz)), radius), start + _TOOL.size


def encode_joint_torque_command(message: JointTorqueCommand) -> bytes:
    """`palpation_msgs/JointTorqueCommand`."""
    torque = fitted(message.torque, _FLOAT64, 7, "torque").tobytes()
    problem = message.problem.encode() + b"\0"
    valid_for = message.valid_for
    return _pack_header(message.header, 8) + _COMMAND.pack(torque, valid_for.sec, valid_for.nanosec, len(problem)) + problem


def decode_joint_torque_command(data: bytes) -> tuple[JointTorqueCommand, int]:
    """`palpation_msgs/JointTorqueCommand`."""
    header, start = _read_header(data, 8)
    torque, sec, nanosec, length = _COMMAND.unpack_from(data, start)
    problem, end = _read_text(data, start + _COMMAND.size, length)
    return JointTorqueCommand(header, np.frombuffer(torque), Duration(sec, nanosec), problem), end


def encode_joint_state(message: JointState) -> bytes:
    """`sensor_msgs/JointState`."""
    data = _pack_header(message.header, 4) + _pack_names(tuple(message.name))
    position = fitted(message.position, _FLOAT64, None, "position")
    velocity = fitted(message.velocity, _FLOAT64, None, "velocity")
    effort = fitted(message.effort, _FLOAT64, None, "effort")
    if position.size == velocity.size == effort.size == 7:
        joints = _JOINTS[_padding(len(data) + _LENGTH.size, 8)]
        return data + joints.pack(7, position.tobytes(), 7, velocity.tobytes(), 7, effort.tobytes())
    for values in (position, velocity, effort):
        count = len(values)
        length = _LENGTH.pack(count)
        if count:  # an empty array has no padding
            length += bytes(_padding(len(data) + _LENGTH.size, 8))
        data += length + values.tobytes()
    return data


def decode_joint_state(data: bytes) -> tuple[JointState, int]:
    """`sensor_msgs/JointState`."""
    header, start = _read_header(data, 4)
    names, start = _read_names(data, start)
    joints = _JOINTS[_padding(start + _LENGTH.size, 8)]
    if len(data) - start == joints.size:
        n, q, n_qd, qd, n_effort, effort = joints.unpack_from(data, start)
        if n == n_qd == n_effort == 7:
            state = JointState(header, names, np.frombuffer(q), np.frombuffer(qd), np.frombuffer(effort))
            return state, len(data)
    position, start = _read_array(data, start)
    velocity, start = _read_array(data, start)
    effort, end = _read_array(data, start)
    return JointState(header, names, position, velocity, effort), end


@lru_cache(maxsize=64)
def _pack_names(names: tuple[str, ...]) -> bytes:
    """A sequence of strings that begins where a number of four bytes may stand, padded for another one."""
    data = bytearray(_LENGTH.pack(len(names)))
    for name in names:
        text = name.encode() + b"\0"
        data += _LENGTH.pack(len(text)) + text
        data += bytes(-len(data) % 4)
    return bytes(data)


class _NamesReader:
    """Reads a sequence of strings. Joint names do not change, so those of the message before are known again by their bytes."""

    def __init__(self) -> None:
        self._last: tuple[bytes, list[str]] = (b"", [])

    def __call__(self, data: bytes, start: int) -> tuple[list[str], int]:
        """The strings of the sequence at `start`, and the position of the number of four bytes that follows."""
        block, last_names = self._last
        if block and data.startswith(block, start):
            return last_names.copy(), start + len(block)
        (count,) = _LENGTH.unpack_from(data, start)
        position = start + _LENGTH.size
        names = []
        for _ in range(count):
            (length,) = _LENGTH.unpack_from(data, position)
            name, end = _read_text(data, position + _LENGTH.size, length)
            names.append(name)
            position = end + _padding(end, 4)
        if position <= len(data):
            self._last = data[start:position], names.copy()
        return names, position


_read_names = _NamesReader()


def _read_array(data: bytes, start: int) -> tuple[NDArray[np.float64], int]:
    """The float64 sequence at `start`, and its end."""
    (count,) = _LENGTH.unpack_from(data, start)
    begin = start + _LENGTH.size
    if count:
        begin += _padding(begin, 8)
    return np.frombuffer(data, _FLOAT64, count, begin), begin + 8 * count


def encode_impedance_setpoint(message: ImpedanceSetpoint) -> bytes:
    """`palpation_msgs/ImpedanceSetpoint`."""
    data = _pack_header(message.header, 1) + _BYTE.pack(message.mode)
    p, q = message.pose.position, message.pose.orientation
    v, w = message.twist.linear, message.twist.angular
    force, torque = message.wrench.force, message.wrench.torque
    return data + bytes(_padding(len(data), 8)) + _SETPOINT.pack(
        p.x, p.y, p.z, q.x, q.y, q.z, q.w,
        v.x, v.y, v.z, w.x, w.y, w.z,
        force.x, force.y, force.z, torque.x, torque.y, torque.z,
        fitted(message.stiffness, _FLOAT64, 6, "stiffness").tobytes(),
        fitted(message.damping_ratio, _FLOAT64, 6, "damping_ratio").tobytes(),
        fitted(message.joint_position, _FLOAT64, 7, "joint_position").tobytes(),
        fitted(message.joint_velocity, _FLOAT64, 7, "joint_velocity").tobytes(),
        fitted(message.joint_stiffness, _FLOAT64, 7, "joint_stiffness").tobytes(),
        message.valid_for.sec, message.valid_for.nanosec,
    )  # fmt: skip


def decode_impedance_setpoint(data: bytes) -> tuple[ImpedanceSetpoint, int]:
    """`palpation_msgs/ImpedanceSetpoint`."""
    header, place = _read_header(data, 1)
    (mode,) = _BYTE.unpack_from(data, place)
    start = place + _BYTE.size + _padding(place + _BYTE.size, 8)
    (
        px, py, pz, qx, qy, qz, qw, vx, vy, vz, wx, wy, wz, fx, fy, fz, tx, ty, tz,
        stiffness, damping_ratio, position, velocity, joint_stiffness, sec, nanosec,
    ) = _SETPOINT.unpack_from(data, start)  # fmt: skip
    message = ImpedanceSetpoint(
        header,
        mode,
        Pose(Point(px, py, pz), Quaternion(qx, qy, qz, qw)),
        Twist(Vector3(vx, vy, vz), Vector3(wx, wy, wz)),
        Wrench(Vector3(fx, fy, fz), Vector3(tx, ty, tz)),
        np.frombuffer(stiffness),
        np.frombuffer(damping_ratio),
        np.frombuffer(position),
        np.frombuffer(velocity),
        np.frombuffer(joint_stiffness),
        Duration(sec, nanosec),
    )
    return message, start + _SETPOINT.size


def encode_robot_status(message: RobotStatus) -> bytes:
    """`palpation_msgs/RobotStatus`."""
    data = _pack_header(message.header, 1) + _BYTE.pack(message.mode) + _BYTE.pack(message.cause)
    reason = message.reason.encode() + b"\0"
    data += bytes(_padding(len(data), 4)) + _LENGTH.pack(len(reason)) + reason
    force, torque = message.wrench.force, message.wrench.torque
    return data + bytes(_padding(len(data), 8)) + _STATUS.pack(
        fitted(message.position, _FLOAT64, 7, "position").tobytes(),
        fitted(message.velocity, _FLOAT64, 7, "velocity").tobytes(),
        force.x, force.y, force.z, torque.x, torque.y, torque.z,
        fitted(message.applied_torque, _FLOAT64, 7, "applied_torque").tobytes(),
        message.commands_rejected,
    )  # fmt: skip


def decode_robot_status(data: bytes) -> tuple[RobotStatus, int]:
    """`palpation_msgs/RobotStatus`."""
    header, place = _read_header(data, 1)
    (mode,), (cause,) = _BYTE.unpack_from(data, place), _BYTE.unpack_from(data, place + 1)
    start = place + 2 + _padding(place + 2, 4)
    (length,) = _LENGTH.unpack_from(data, start)
    reason, end = _read_text(data, start + _LENGTH.size, length)
    start = end + _padding(end, 8)
    position, velocity, fx, fy, fz, tx, ty, tz, applied, rejected = _STATUS.unpack_from(data, start)
    message = RobotStatus(
        header,
        mode,
        cause,
        reason,
        np.frombuffer(position),
        np.frombuffer(velocity),
        Wrench(Vector3(fx, fy, fz), Vector3(tx, ty, tz)),
        np.frombuffer(applied),
        rejected,
    )
    return message, start + _STATUS.size


class StructCodec(NamedTuple):
    """The two functions of one message type."""

    encode: Callable[[Any], bytes]
    decode: Callable[[bytes], tuple[Any, int]]


STRUCT_CODECS: dict[str, StructCodec] = {
    "geometry_msgs/msg/WrenchStamped": StructCodec(encode_wrench_stamped, decode_wrench_stamped),
    "palpation_msgs/msg/ImpedanceSetpoint": StructCodec(encode_impedance_setpoint, decode_impedance_setpoint),
    "palpation_msgs/msg/JointTorqueCommand": StructCodec(encode_joint_torque_command, decode_joint_torque_command),
    "palpation_msgs/msg/RobotStatus": StructCodec(encode_robot_status, decode_robot_status),
    "palpation_msgs/msg/ToolState": StructCodec(encode_tool_state, decode_tool_state),
    "sensor_msgs/msg/JointState": StructCodec(encode_joint_state, decode_joint_state),
}
