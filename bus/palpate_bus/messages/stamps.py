"""ROS times, durations and headers from integer nanoseconds, and back; messages that have only these."""

from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype

from palpate_bus.messages import Duration, Header, Time
from palpate_bus.messages.typestore import array_dtype, message_type, store

NS = 1_000_000_000
"""Nanoseconds per second."""
MS = 1_000_000
"""Nanoseconds per millisecond."""
UNIX_NS = 10**17
"""Stamps from here on [ns] are Unix time, not the simulated time of a run."""


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


def blank(name: str, t: int = 0, frame: str = "") -> Any:
    """Return a message of zeros, empty texts and empty lists; its headers are stamped `t` [ns], in `frame`."""
    if name == "std_msgs/msg/Header":
        return header(t, frame)
    return message_type(name)(*(_zero(kind, detail, t, frame) for _, (kind, detail) in store.get_msgdef(name).fields))


def _zero(kind: int, detail: Any, t: int, frame: str) -> Any:
    if kind == Nodetype.NAME:
        return blank(detail, t, frame)
    if kind == Nodetype.BASE:
        return "" if detail[0] == "string" else array_dtype(detail[0]).type(0).item()
    (item_kind, item), length = detail
    if item_kind == Nodetype.NAME or item[0] == "string":
        return []
    return np.zeros(length if kind == Nodetype.ARRAY else 0, array_dtype(item[0]))
