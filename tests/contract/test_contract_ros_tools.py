"""Clock, frames, description, diagnostics and QoS of a recorded examination, as RViz, rqt and `ros2 bag play` need them."""

import xml.etree.ElementTree as ET
from collections.abc import Iterator
from itertools import pairwise
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from examination import Finished
from rosbags.highlevel import AnyReader
from rosbags.interfaces import QosDurability, QosReliability
from rosbags.typesys import Stores, get_typestore

from palpate_bus.contract import contract
from palpate_bus.contract.port_check import ViolationKind
from palpate_bus.messages import nanoseconds

RULES = contract()
TYPES = {
    "/clock": "rosgraph_msgs/msg/Clock",
    "/tf": "tf2_msgs/msg/TFMessage",
    "/tf_static": "tf2_msgs/msg/TFMessage",
    "/robot_description": "std_msgs/msg/String",
    "/diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
    "/joint_states": "sensor_msgs/msg/JointState",
}
TRANSIENT_LOCAL = ("/tf_static", "/robot_description")


@pytest.fixture(scope="module")
def bag(distributed: Finished) -> Iterator[AnyReader]:
    """Return the recording of a short examination, opened without Palpate."""
    with AnyReader([distributed.folder / "recording_mcap"], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as reader:
        yield reader


def messages(bag: AnyReader, topic: str) -> list[Any]:
    connections = [connection for connection in bag.connections if connection.topic == topic]
    return [bag.deserialize(raw, connection.msgtype) for connection, _, raw in bag.messages(connections)]


def test_types_and_qos(bag: AnyReader) -> None:
    by_topic = {connection.topic: connection for connection in bag.connections}
    assert {topic: by_topic[topic].msgtype for topic in TYPES} == TYPES
    for topic in TYPES:
        (qos,) = by_topic[topic].ext.offered_qos_profiles
        assert qos.reliability is QosReliability.RELIABLE, topic
        assert (qos.durability is QosDurability.TRANSIENT_LOCAL) is (topic in TRANSIENT_LOCAL), topic
        assert by_topic[topic].msgcount > 0, topic
    assert all(by_topic[topic].msgcount == 1 for topic in TRANSIENT_LOCAL)


def frames(bag: AnyReader) -> dict[str, str]:
    """Parent of each frame."""
    parents: dict[str, str] = {}
    for topic in ("/tf", "/tf_static"):
        for message in messages(bag, topic):
            for item in message.transforms:
                parent = parents.setdefault(item.child_frame_id, item.header.frame_id)
                assert parent == item.header.frame_id, f"{item.child_frame_id} has two parents"
                q = item.transform.rotation
                assert np.linalg.norm((q.x, q.y, q.z, q.w)) == pytest.approx(1.0, abs=1e-6)
    return parents


def test_one_tree_of_frames_from_the_world_to_every_sensor(bag: AnyReader) -> None:
    parents = frames(bag)
    for frame in parents:
        path = [frame]
        while path[-1] in parents:
            path.append(parents[path[-1]])
            assert len(path) <= len(parents) + 1, f"{frame} is in a circle"
        assert path[-1] == "world", path
    named = {topic.frame for topic in RULES.topics.values() if topic.frame}
    assert named <= parents.keys() | {"world"}
    used = {
        getattr(message, "header").frame_id  # noqa: B009  # the types come from the bag
        for topic in ("/ft/wrench", "/camera/depth/image_raw", "/camera/depth/camera_info", "/perception/points")
        for message in messages(bag, topic)[:1]
    }
    assert used <= parents.keys() | {"world"}
    assert {"ft_sensor", "camera_depth_optical_frame"} <= used


def test_the_description_is_a_urdf_of_the_joints_and_frames_there_are(bag: AnyReader) -> None:
    (description,) = messages(bag, "/robot_description")
    model = pin.buildModelFromXML(description.data)
    joints = [joint.attrib["name"] for joint in ET.fromstring(description.data).iter("joint") if joint.attrib["type"] != "fixed"]
    states = messages(bag, "/joint_states")
    assert list(states[0].name) == joints == list(model.names)[1:]
    links = {frame.name for frame in model.frames if frame.type == pin.FrameType.BODY}
    assert links - {"world"} <= frames(bag).keys()
    geometry = pin.buildGeomFromUrdfString(model, description.data, pin.GeometryType.VISUAL)
    assert len(geometry.geometryObjects) >= 8


def test_tf_is_where_the_described_arm_is_at_its_measured_joints(bag: AnyReader) -> None:
    (description,) = messages(bag, "/robot_description")
    model = pin.buildModelFromXML(description.data)
    data = model.createData()
    states = {nanoseconds(state.header.stamp): np.asarray(state.position) for state in messages(bag, "/joint_states")}
    trees = messages(bag, "/tf")
    for tree in trees[:: len(trees) // 20]:
        X = np.eye(4)
        for item in tree.transforms[:11]:
            p, q = item.transform.translation, item.transform.rotation
            X = X @ pin.XYZQUATToSE3(np.array((p.x, p.y, p.z, q.x, q.y, q.z, q.w))).homogeneous
        assert tree.transforms[10].child_frame_id == "indenter"
        pin.framesForwardKinematics(model, data, states[nanoseconds(tree.transforms[0].header.stamp)])
        # The status from which tf is made is a mean over 10 ms, in which the tool moves by some mm at most.
        assert np.linalg.norm(X[:3, 3] - data.oMf[model.getFrameId("indenter")].translation) < 0.01


PACE = {str(kind) for kind in (ViolationKind.AGE, ViolationKind.RATE, ViolationKind.SILENT)}
"""Violations that an overloaded machine makes by itself."""


def test_diagnostics_name_every_service_and_topic_and_a_sound_run_violates_nothing(bag: AnyReader) -> None:
    arrays = messages(bag, "/diagnostics")
    stamps = [nanoseconds(message.header.stamp) for message in arrays]
    assert all(a < b for a, b in pairwise(stamps))
    for array in arrays:
        names = [status.name for status in array.status]
        assert len(names) == len(set(names))
        assert {f"palpate/topic/{topic}" for topic in RULES.topics} <= set(names)
        assert {f"palpate/{role}" for role in ("robot", "tissue", "control", "recorder")} <= set(names)
        for status in array.status:
            assert status.level in (0, 1, 2, 3)
            assert status.message
            assert status.hardware_id
            found = {item.key for item in status.values} & {str(kind) for kind in ViolationKind}
            assert found <= PACE, f"{status.name}: {status.message}"
            assert status.level < 2 or found or "expected" in status.message
