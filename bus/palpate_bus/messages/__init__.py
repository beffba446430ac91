"""Message classes by short name: `from palpate_bus.messages import JointState`.

The classes come from the typestore at run time, so type checkers see `Any`.
"""

from __future__ import annotations

from typing import Any

from palpate_bus.messages.codec import message_type, store

_SHORT: dict[str, str] = {}
for _name in store.types:
    _package, _, _base = _name.partition("/msg/")
    if _base and (_package == "palpation_msgs" or _base not in _SHORT or not _SHORT[_base].startswith("palpation_msgs")):
        preferred = ("palpation_msgs", "sensor_msgs", "geometry_msgs", "std_msgs", "builtin_interfaces")
        if _base not in _SHORT or _package in preferred:
            _SHORT[_base] = _name


def __getattr__(name: str) -> Any:
    if name in _SHORT:
        return message_type(_SHORT[name])
    raise AttributeError(f"no message {name!r}; use palpate_bus.messages.codec.message_type('<package>/msg/<Name>')")
