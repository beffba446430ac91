"""Encoding and decoding of a joint state and a depth image: our codec and that of rosbags."""

import random
from typing import Any

import numpy as np

from palpate_bus.messages import Image, JointState, codec, header


def example(name: str) -> tuple[str, Any]:
    """Type and example of a message: a joint state of 300 B, or a depth image of 640 x 480 floats."""
    if name == "joint_state":
        values = np.random.default_rng(0).random(7)
        return "sensor_msgs/msg/JointState", JointState(header(1), [f"joint_{i}" for i in range(1, 8)], *[values] * 3)
    pixels = np.frombuffer(random.Random(0).randbytes(640 * 480 * 4), np.uint8)
    return "sensor_msgs/msg/Image", Image(header(1, "camera"), 480, 640, "32FC1", 0, 2560, pixels)


class Codec:
    """One message through one codec."""

    params = (["joint_state", "image"], ["palpate", "rosbags"])
    param_names = ("message", "codec")

    def setup(self, name: str, by: str) -> None:
        """Prepare encoder, decoder and payload."""
        kind, self.message = example(name)
        self.payload = codec.encode(self.message, kind)
        if by == "palpate":
            self.encode, self.decode = codec.encoder(kind), codec.decoder(kind)
        else:
            self.encode = lambda message: codec.store.serialize_cdr(message, kind)
            self.decode = lambda payload: codec.store.deserialize_cdr(payload, kind)

    def time_encode(self, *_: str) -> None:
        """Encode the message."""
        self.encode(self.message)

    def time_decode(self, *_: str) -> None:
        """Decode the payload."""
        self.decode(self.payload)
