"""ROS times, durations and headers from integer nanoseconds, and back."""

from __future__ import annotations

from typing import Any

from palpate_bus.messages.codec import Message, message_type

_Time: Any = message_type("builtin_interfaces/msg/Time")
_Duration: Any = message_type("builtin_interfaces/msg/Duration")
_Header: Any = message_type("std_msgs/msg/Header")

NS = 1_000_000_000
"""Nanoseconds in a second."""


def time_message(t: int) -> Message:
    """`builtin_interfaces/Time` of `t` [ns]."""
    return _Time(t // NS, t % NS)


def duration_message(t: int) -> Message:
    """`builtin_interfaces/Duration` of `t` [ns]."""
    return _Duration(t // NS, t % NS)


def header(t: int, frame_id: str = "") -> Message:
    """`std_msgs/Header` stamped `t` [ns]."""
    return _Header(_Time(t // NS, t % NS), frame_id)


def nanoseconds(time_or_duration: Message) -> int:
    """A Time or Duration message in nanoseconds."""
    return int(time_or_duration.sec) * NS + int(time_or_duration.nanosec)
