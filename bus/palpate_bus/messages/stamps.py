"""ROS times, durations and headers from integer nanoseconds, and back."""

from __future__ import annotations

from palpate_bus.messages import Duration, Header, Time

NS = 1_000_000_000
"""Nanoseconds in a second."""


def time_message(t: int) -> Time:
    """`builtin_interfaces/Time` of `t` [ns]."""
    return Time(t // NS, t % NS)


def duration_message(t: int) -> Duration:
    """`builtin_interfaces/Duration` of `t` [ns]."""
    return Duration(t // NS, t % NS)


def header(t: int, frame_id: str = "") -> Header:
    """`std_msgs/Header` stamped `t` [ns]."""
    return Header(Time(t // NS, t % NS), frame_id)


def nanoseconds(time_or_duration: Time | Duration) -> int:
    """A Time or Duration message in nanoseconds."""
    return int(time_or_duration.sec) * NS + int(time_or_duration.nanosec)
