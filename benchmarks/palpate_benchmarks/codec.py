"""Codec times [us], ours against rosbags' own on the same messages, the best of nine repeats each."""

from __future__ import annotations

import random
from collections.abc import Callable
from functools import partial
from timeit import repeat
from typing import Any

import numpy as np

from palpate_bus.messages import Image, JointState, codec
from palpate_bus.messages.stamps import header

REPEATS = 9


def _messages() -> dict[str, tuple[str, Any]]:
    values = np.random.default_rng(0).random(7)
    pixels = np.frombuffer(random.Random(0).randbytes(640 * 480 * 4), np.uint8)
    return {
        "joint_state": ("sensor_msgs/msg/JointState", JointState(header(1), [f"lbr_A{i}" for i in range(1, 8)], *[values] * 3)),
        "image": ("sensor_msgs/msg/Image", Image(header(1, "camera"), 480, 640, "32FC1", 0, 2560, pixels)),
    }


def measure() -> dict[str, float]:
    """Encoding and decoding of a joint state and a depth image, and how many times faster ours is."""
    figures: dict[str, float] = {}
    for name, (kind, message) in _messages().items():
        payload = codec.encode(message, kind)
        number = 2000 if len(payload) < 1000 else 100
        encode, decode = codec.encoder(kind), codec.decoder(kind)
        pairs: dict[str, tuple[Callable[[], object], Callable[[], object]]] = {
            "encode": (partial(encode, message), partial(codec.store.serialize_cdr, message, kind)),
            "decode": (partial(decode, payload), partial(codec.store.deserialize_cdr, payload, kind)),
        }
        for what, (ours, theirs) in pairs.items():
            ours_us, theirs_us = (min(repeat(f, number=number, repeat=REPEATS)) / number * 1e6 for f in (ours, theirs))
            figures |= {
                f"{name}_{what}_us": ours_us,
                f"{name}_{what}_rosbags_us": theirs_us,
                f"{name}_{what}_x": theirs_us / ours_us,
            }
    return figures
