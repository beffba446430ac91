"""A ROS 2 user without ROS and without anything of ours: zenoh-ros2-sdk, an independent client of rmw_zenoh's wire.

    python tests/contract/ros2_client.py PORT DEFINITIONS [--domain 0] [--seconds 120]

PORT is a router's on this host; DEFINITIONS a folder <package>/msg/<Name>.msg, so that nothing is cloned. Discovers nodes and
topics, receives joint states, a wrench and a depth image, asks an operator's stop, and waits until the robot says that it holds.
Prints one JSON line for each, and leaves with 0 when all came.
"""

import argparse
import json
import logging
import sys
import threading
import time

import zenoh_ros2_sdk as ros2
from zenoh_ros2_sdk import ROS2Publisher, ROS2Subscriber, ZenohSession, get_message_class

TOPICS = {
    "/joint_states": ("sensor_msgs/msg/JointState", lambda message: {"names": list(message.name)}),
    "/ft/wrench": ("geometry_msgs/msg/WrenchStamped", lambda message: {"frame": message.header.frame_id}),
    "/camera/depth/image_raw": ("sensor_msgs/msg/Image", lambda message: {"size": [message.height, message.width]}),
}
"""Type of each topic, and what is printed of its first message."""
SAFE_HOLD, STOP_REQUESTED, STOP = 2, 8, 0


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("port", type=int)
    parser.add_argument("definitions")
    parser.add_argument("--domain", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=120.0)
    options = parser.parse_args()
    logging.basicConfig(level=logging.WARNING)
    where = {"domain_id": options.domain, "router_port": options.port}
    ZenohSession.get_instance("127.0.0.1", options.port)
    ros2.get_registry(options.definitions)
    end = time.monotonic() + options.seconds
    lock = threading.Lock()
    received = set()
    held = threading.Event()

    def receive(topic, summary):
        def callback(message):
            with lock:
                if topic not in received:
                    received.add(topic)
                    print(json.dumps({"received": topic, **summary(message)}), flush=True)

        return callback

    def watch(message):
        if message.mode == SAFE_HOLD and message.cause == STOP_REQUESTED:
            if not held.is_set():
                print(json.dumps({"robot": message.reason}), flush=True)
            held.set()

    subscribers = [ROS2Subscriber(topic, kind, receive(topic, of), **where) for topic, (kind, of) in TOPICS.items()]
    subscribers.append(ROS2Subscriber("/robot/status", "palpation_msgs/msg/RobotStatus", watch, **where))
    print(json.dumps({"listening": sorted(TOPICS)}), flush=True)
    while len(received) < len(TOPICS) and time.monotonic() < end:
        time.sleep(0.1)
    names = dict(ros2.get_topic_names_and_types(domain_id=options.domain, router_port=options.port, timeout=2.0))
    info = ros2.get_topic_info("/joint_states", domain_id=options.domain, router_port=options.port, timeout=2.0, verbose=True)
    print(json.dumps({"topics": sorted(names), "publishers": sorted({p.node_name for p in info.publishers})}), flush=True)

    kind = "palpation_msgs/msg/OperatorRequest"
    publisher = ROS2Publisher("/operator/request", kind, **where)
    header = get_message_class("std_msgs/msg/Header")(get_message_class("builtin_interfaces/msg/Time")(0, 0), "")
    while not held.is_set() and time.monotonic() < end:
        publisher.publish(header=header, request=STOP, reason="asked from ROS 2")
        held.wait(0.5)
    for subscriber in subscribers:
        subscriber.close()
    publisher.close()
    return 0 if held.is_set() and len(received) == len(TOPICS) else 1


if __name__ == "__main__":
    sys.exit(main())
