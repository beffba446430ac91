"""ROS times, durations and headers from integer nanoseconds, and back."""

from palpate_bus.messages import Duration, Header, Time

NS = 1_000_000_000
"""Nanoseconds per second."""


def time_message(t: int) -> Time:
    """Return the `Time` of `t` [ns]."""
    return Time(t // NS, t % NS)


def duration_message(t: int) -> Duration:
    """Return the `Duration` of `t` [ns]."""
    return Duration(t // NS, t % NS)


def header(t: int, frame_id: str = "") -> Header:
    """Return the `Header` with stamp `t` [ns]."""
    return Header(Time(t // NS, t % NS), frame_id)


def nanoseconds(time_or_duration: Time | Duration) -> int:
    """Return a `Time` or `Duration` in nanoseconds."""
    return int(time_or_duration.sec) * NS + int(time_or_duration.nanosec)
