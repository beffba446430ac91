"""A stranger on the bus: joins it with zenoh and rosbags alone, nothing of ours, and reads three standard topics.

    python tests/contract/foreign_listener.py ENDPOINT [ENDPOINT...] [--domain 0] [--count 3] [--seconds 60] [--topics ...]

ENDPOINT is where services listen: `unixsock-stream//run/palpate/robot.sock`, `tcp/127.0.0.1:7447`. Peers do not route, so name
every service whose topics you want, or a router. Prints one JSON line a topic and leaves with 0 when each gave COUNT messages.
"""

import argparse
import json
import sys
import time
from queue import Empty, SimpleQueue

import numpy as np
import zenoh
from rosbags.typesys import Stores, get_typestore

TOPICS = {
    "joint_states": "sensor_msgs/msg/JointState",
    "ft/wrench": "geometry_msgs/msg/WrenchStamped",
    "camera/depth/image_raw": "sensor_msgs/msg/Image",
}
ATTACHMENT_SIZE = 33  # int64 sequence, int64 time stamp, length of the GID, GID of 16 bytes


def key(store, topic, type_name, domain):
    package, _, base = type_name.split("/")
    return f"{domain}/{topic}/{package}::msg::dds_::{base}_/{store.hash_rihs01(type_name)}"


def summary(topic, message):
    stamp = message.header.stamp.sec + message.header.stamp.nanosec * 1e-9
    if topic == "joint_states":
        value = {"names": message.name, "position": message.position.tolist(), "effort": message.effort.tolist()}
    elif topic == "ft/wrench":
        force = message.wrench.force
        value = {"force": [force.x, force.y, force.z]}
    else:
        depth = np.frombuffer(message.data, "<f4").reshape(message.height, message.width)
        valid = depth[np.isfinite(depth)]
        value = {"shape": list(depth.shape), "encoding": message.encoding, "valid": int(valid.size)}
        value |= {"least": float(valid.min()), "most": float(valid.max())} if valid.size else {}
    return {"topic": topic, "stamp": stamp, "frame": message.header.frame_id, **value}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("endpoints", nargs="+")
    parser.add_argument("--domain", type=int, default=0)
    parser.add_argument("--count", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--topics", nargs="+", choices=TOPICS, default=list(TOPICS))
    options = parser.parse_args()

    store = get_typestore(Stores.ROS2_JAZZY)
    config = zenoh.Config()
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("listen/endpoints", "[]")
    config.insert_json5("connect/endpoints", json.dumps(options.endpoints))
    config.insert_json5("connect/retry", '{"period_init_ms": 50, "period_max_ms": 200, "period_increase_factor": 1.5}')
    queue = SimpleQueue()
    counts = dict.fromkeys(options.topics, 0)
    with zenoh.open(config) as session:
        for topic in options.topics:
            handler = zenoh.handlers.Callback(lambda sample, topic=topic: queue.put((topic, sample)), indirect=False)
            session.declare_subscriber(key(store, topic, TOPICS[topic], options.domain), handler)
        print("listening", flush=True)
        end = time.monotonic() + options.seconds
        while min(counts.values()) < options.count and time.monotonic() < end:
            try:
                topic, sample = queue.get(timeout=0.2)
            except Empty:
                continue
            payload = sample.payload.to_bytes()
            if len(sample.attachment.to_bytes()) != ATTACHMENT_SIZE or counts[topic] >= options.count:
                continue
            message = store.deserialize_cdr(payload, TOPICS[topic])
            counts[topic] += 1
            if counts[topic] == options.count:
                print(json.dumps(summary(topic, message)), flush=True)
    return 0 if min(counts.values()) >= options.count else 1


if __name__ == "__main__":
    sys.exit(main())
