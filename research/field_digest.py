"""Digest of a run's recording over all message fields except strings: `python -m research.field_digest RUN_FOLDER`.

The run hash covers message texts, so it changes when a text is reworded. This digest does not: it shows that a change of texts,
names or message types left every number unchanged. It reads the MCAP file of a run with `--record full`.
`field_digests.json` has the digests of commit 18583e7e on one machine; on another, compare two commits. `region` is
`exam.region_m=[0.06,0.06]`, `exam.centre_m=[-0.055,-0.055]`, `exam.spacing_m=0.02`, `camera.frames=10`; all are composed runs.
"""

import dataclasses
import hashlib
import re
import sys
from pathlib import Path
from typing import Any, Final

import numpy as np
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.msg import get_types_from_msg

from palpate_bus.recordings import open_recording

ADDED: Final = {
    "palpation_msgs/msg/JointTorqueCommand": re.compile("position"),
    "palpation_msgs/msg/PalpationTargets": re.compile("reason|[A-Z_]+"),
    "palpation_msgs/msg/Finding": re.compile("ridge|bone|soft|kind|KIND_[A-Z_]+"),
    "palpation_msgs/msg/ExamState": re.compile("reason|REASON_[A-Z_]+"),
    "palpation_msgs/msg/RobotStatus": re.compile("measured_torque"),
    "palpation_msgs/msg/SupervisorState": re.compile("joint_force|CAUSE_SENSOR"),
}
"""Fields and constants by message type that did not exist when the digests were recorded (rosbags lists constants as fields)."""
NOT_HASHED: Final = ("record_chunks", "diagnostics", "clock")
"""Topics that depend on the machine."""


def update(digest: Any, value: Any, kind: str = "") -> None:
    """Add the numbers of `value`, field by field; skips strings and `ADDED` fields."""
    if isinstance(value, str):
        return
    if dataclasses.is_dataclass(value):
        kind = getattr(value, "__msgtype__", kind)
        for field in dataclasses.fields(value):
            if field.name != "__msgtype__" and not (kind in ADDED and ADDED[kind].fullmatch(field.name)):
                update(digest, getattr(value, field.name))
    elif isinstance(value, np.ndarray):
        digest.update(value.tobytes())
    elif isinstance(value, (list, tuple)):
        digest.update(len(value).to_bytes(4, "little"))
        for one in value:
            update(digest, one)
    else:
        digest.update(repr(value).encode() + b";")


def digests(folder: Path) -> dict[str, str]:
    """Return the digest of each recorded topic."""
    store = get_typestore(Stores.ROS2_JAZZY)
    by_topic: dict[str, Any] = {}
    recording = open_recording(folder)
    for topic, kind in recording.types.items():
        head, *parts = kind.definition.split("=" * 80)
        types = get_types_from_msg(head.strip("\n"), kind.name)
        for part in parts:
            line, _, text = part.strip("\n").partition("\n")
            name = line.removeprefix("MSG: ").strip()
            types |= get_types_from_msg(text, name if "/msg/" in name else name.replace("/", "/msg/"))
        store.register({k: v for k, v in types.items() if k not in store.types})
        if not topic.endswith(NOT_HASHED) and recording.counts[topic]:
            by_topic[f"/{topic}"] = hashlib.sha256()
    for message in recording.messages([topic.removeprefix("/") for topic in by_topic]):
        digest = by_topic[f"/{message.topic}"]
        digest.update(f"{message.sequence} {message.stamp};".encode())
        update(digest, store.deserialize_cdr(message.payload, recording.types[message.topic].name))
    return {topic: digest.hexdigest()[:16] for topic, digest in sorted(by_topic.items())}


def main() -> None:
    """Print the digest of each topic, and of all topics."""
    found = digests(Path(sys.argv[1]))
    whole = hashlib.sha256("".join(f"{k} {v}\n" for k, v in found.items()).encode()).hexdigest()
    for topic, digest in found.items():
        print(digest, topic)
    print(whole[:16], "all")


if __name__ == "__main__":
    main()
