"""Bags of other writers: MCAP and SQLite, poses as topic, tf or joints; the same as a table."""

import runpy
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from rosbags.rosbag2 import StoragePlugin, Writer
from scipy.spatial.transform import Rotation

from palpate.recording.cutting import cycles, onset
from palpate.recording.mapping import Joints, MappedTool, Mapping, Topics, Transform
from palpate.recording.read import read_recording
from palpate.recording.readings import ReadingError, _kinematics, _without_pose
from palpate.recording.recording import Contact, ContactKind, FaultCode, loading
from palpate_bus import messages as msg
from palpate_bus.messages import NS, header
from palpate_bus.messages.typestore import store

EXAMPLE = Path(__file__).resolve().parents[2] / "docs" / "examples" / "make_recording.py"
TOOL = MappedTool(radius_m=0.015, mass_kg=0.5)
SLIDERS = """<robot name="gantry"><link name="world"/><link name="a"/><link name="b"/><link name="tool"/>
<joint name="x" type="prismatic"><parent link="world"/><child link="a"/><axis xyz="1 0 0"/>{0}</joint>
<joint name="y" type="prismatic"><parent link="a"/><child link="b"/><axis xyz="0 1 0"/>{0}</joint>
<joint name="z" type="prismatic"><parent link="b"/><child link="tool"/><axis xyz="0 0 1"/>{0}</joint></robot>
""".format('<limit lower="-1" upper="1" effort="1" velocity="1"/>')
POSES = {
    "topic": "/tool_pose",
    "tf": Transform(parent="world", child="tool"),
    "joints": Joints(topic="/joints", urdf=Path("gantry.urdf"), frame="tool"),
}


@pytest.fixture(scope="module")
def few() -> pd.DataFrame:
    return runpy.run_path(str(EXAMPLE))["recording"](spacing=0.05)


def write(
    folder: Path,
    table: pd.DataFrame,
    plugin: StoragePlugin,
    stamp: Callable[[int], int] = lambda t: t,
    logged: Callable[[int], int] = lambda t: t,
    oriented: bool = True,
    topics: tuple[str, ...] = ("/wrench", "/tool_pose", "/tf", "/joints"),
    hidden: tuple[float, float] = (0.0, 0.0),
) -> None:
    """Poses at 50 Hz, wrenches at 100 Hz in the axes of a tool that is turned about z, with its weight."""
    turn = Rotation.from_euler("z", 0.7)
    q = msg.Quaternion(*(turn.as_quat() if oriented else np.zeros(4)))
    weighed = turn.inv().apply(table[["fx", "fy", "fz"]].to_numpy() + np.array((0.0, 0.0, -9.81 * TOOL.mass_kg)))
    with Writer(folder, version=9, storage_plugin=plugin) as bag:
        types = {"/wrench": msg.WrenchStamped, "/tool_pose": msg.PoseStamped, "/tf": msg.TFMessage, "/joints": msg.JointState}
        connections = {name: bag.add_connection(name, kind.__msgtype__, typestore=store) for name, kind in types.items()}

        def send(name: str, message: object, t: int) -> None:
            if name in topics:
                bag.write(connections[name], logged(t), store.serialize_cdr(message, types[name].__msgtype__))

        for k, (row, force) in enumerate(zip(table.itertuples(), weighed, strict=True)):
            t = round((row.t + 1000) * NS)
            wrench = msg.Wrench(msg.Vector3(*force), msg.Vector3(0.0, 0.0, 0.0))
            send("/wrench", msg.WrenchStamped(header(stamp(t), "tool"), wrench), t)
            if k % 2 == 0 and not hidden[0] < row.t < hidden[1]:
                p = (row.x, row.y, row.z)
                send("/tool_pose", msg.PoseStamped(header(stamp(t), "world"), msg.Pose(msg.Point(*p), q)), t)
                transform = msg.TransformStamped(header(t, "world"), "tool", msg.Transform(msg.Vector3(*p), q))
                send("/tf", msg.TFMessage([transform]), t)
                names = list("xyz" if k % 4 else "zxy")  # the order changes
                q_now = np.array([getattr(row, name) for name in names])
                send("/joints", msg.JointState(header(t), names, q_now, np.empty(0), np.empty(0)), t)


def mapped(pose: object = "/tool_pose", **fields: object) -> Mapping:
    return Mapping.model_validate({"topics": Topics.model_validate({"wrench": "/wrench", "pose": pose}), "tool": TOOL, **fields})


@pytest.mark.parametrize("plugin", list(StoragePlugin))
@pytest.mark.parametrize("pose", POSES)
def test_a_bag_gives_the_contacts_of_its_table(few: pd.DataFrame, tmp_path: Path, pose: str, plugin: StoragePlugin) -> None:
    write(tmp_path / "bag", few, plugin)
    (tmp_path / "gantry.urdf").write_text(SLIDERS)
    source = POSES[pose]
    if isinstance(source, Joints):
        source = source.model_copy(update={"urdf": tmp_path / "gantry.urdf"})
    yaw = 0.7 if pose == "joints" else 0.0
    recording = read_recording(tmp_path / "bag", mapped(source, force={"axes": "tool", "rpy_rad": (0, 0, yaw)}))
    assert not recording.faults
    assert len(recording.touches) == 9
    assert abs(recording.depth_m - 0.010) < 0.0008


STAMPS = {
    "none": (lambda t: 0, lambda t: t),
    "whole seconds": (lambda t: t // NS * NS, lambda t: t),
    "a log that goes back": (lambda t: t, lambda t: 10**13 - t),
    "a log without time": (lambda t: t, lambda t: 0),
}


@pytest.mark.parametrize(("stamp", "logged"), STAMPS.values(), ids=STAMPS)
def test_stamps_that_repeat_are_replaced_by_the_times_of_the_log(
    few: pd.DataFrame, tmp_path: Path, stamp: Callable[[int], int], logged: Callable[[int], int]
) -> None:
    write(tmp_path / "bag", few, StoragePlugin.MCAP, stamp, logged)
    recording = read_recording(tmp_path / "bag", mapped(force={"axes": "tool"}))
    assert not recording.faults
    assert len(recording.touches) == 9


def test_a_joint_without_limits_turns_as_one_with_limits(tmp_path: Path) -> None:
    found = []
    for kind in ("revolute", "continuous"):
        (tmp_path / "arm.urdf").write_text(
            f'<robot name="arm"><link name="world"/><link name="a"/><link name="tool"/><joint name="q" type="{kind}">'
            '<parent link="world"/><child link="a"/><axis xyz="0 0 1"/><limit lower="-1" upper="1" effort="1" velocity="1"/>'
            '</joint><joint name="end" type="fixed"><parent link="a"/><child link="tool"/><origin xyz="0.5 0 0"/></joint></robot>'
        )
        state = msg.JointState(header(0, ""), ["q"], np.array((0.5,)), np.empty(0), np.empty(0))
        found += [*_kinematics([((0.0, 0.0), state)], Joints(topic="/q", urdf=tmp_path / "arm.urdf", frame="tool"))[1]]
    np.testing.assert_allclose(found, [(0.5 * np.cos(0.5), 0.5 * np.sin(0.5), 0.0)] * 2, atol=1e-12)


def test_poses_without_an_orientation_are_positions(few: pd.DataFrame, tmp_path: Path) -> None:
    write(tmp_path / "bag", few, StoragePlugin.MCAP, oriented=False)
    assert len(read_recording(tmp_path / "bag", mapped()).touches) == 9
    with pytest.raises(ReadingError, match="no orientation"):
        read_recording(tmp_path / "bag", mapped(force={"axes": "tool"}))


def test_a_bag_without_messages_is_refused(few: pd.DataFrame, tmp_path: Path) -> None:
    write(tmp_path / "bag", few[:0], StoragePlugin.MCAP)
    with pytest.raises(ReadingError, match="0 poses and 0 wrenches; expected at least 2 and 1"):
        read_recording(tmp_path / "bag", mapped())


def test_a_bag_without_wrenches_is_refused(few: pd.DataFrame, tmp_path: Path) -> None:
    write(tmp_path / "bag", few[:100], StoragePlugin.MCAP, topics=("/tool_pose",))
    with pytest.raises(ReadingError, match="50 poses and 0 wrenches"):
        read_recording(tmp_path / "bag", mapped())


def test_missing_poses_are_not_made_up(few: pd.DataFrame, tmp_path: Path) -> None:
    """Tracking is lost for 0.7 s in a descent; a slower link of tf ends early."""
    start = few.t[few.z.iloc[500:625].idxmin()] - 0.6
    write(tmp_path / "bag", few, StoragePlugin.MCAP, hidden=(start, start + 0.7))
    recording = read_recording(tmp_path / "bag", mapped())
    assert {fault.code: fault.count for fault in recording.faults}[FaultCode.INVALID] == pytest.approx(70, abs=3)
    missing = _without_pose(np.array((0.0, 0.5, 2.9, 3.0, 6.0, 12.0)), np.array((0.0, 1.0, 2.0, 3.0, 9.0, *range(10, 40))))
    assert missing.tolist() == [False, False, False, False, True, False]
    assert _without_pose(np.array((39.0, 42.0, 44.0)), np.arange(40.0)).tolist() == [False, False, True]


def pressed(depth: np.ndarray, force: np.ndarray, noise: float) -> Contact:
    nowhere = np.zeros((len(depth), 3))
    return Contact(ContactKind.PRESS, nowhere, nowhere, depth, force, 0.0, noise)


@pytest.mark.parametrize(("exponent", "spread"), [(1.1, 0.0), (2.9, 0.6)])
def test_force_and_exponent_are_those_of_the_body(exponent: float, spread: float) -> None:
    rng = np.random.default_rng(0)
    depth, noise = np.linspace(0.0, 0.002, 10), 0.03
    level, own = 1.0 + 0.2 * rng.standard_normal(200), exponent + spread * rng.standard_normal(200)
    forces = [f * (depth / 0.002) ** n + noise * rng.standard_normal(10) for f, n in zip(level, own, strict=True)]
    found = loading([pressed(depth, force, noise) for force in forces], 0.002)
    assert found.exponent == pytest.approx(exponent, rel=0.05)
    assert found.exponent_sd == pytest.approx(spread, abs=0.15)
    z = (found.force - level) / found.noise
    assert abs(z.mean()) < 0.3
    assert 0.8 < z.std() < 1.2


def test_a_press_of_one_reading_keeps_it() -> None:
    found = loading([pressed(np.array((0.002,)), np.array((0.7,)), 0.01)], 0.002)
    assert found.force == pytest.approx((0.7,))


@pytest.mark.parametrize("per_cycle", [12, 40])
def test_a_slide_that_pushes_in_and_out_shows_stiffness_and_skin(per_cycle: int) -> None:
    """The skin slopes, so that neither height nor force alone shows where it is; the force is controlled."""
    rng = np.random.default_rng(0)
    k = np.arange(60 * per_cycle)
    x = 0.0015 * k / per_cycle
    force = 1.2 - np.cos(2 * np.pi * k / per_cycle)
    stiffness = np.where(x < 0.045, 3e3, 4.5e3)
    inward = 0.2 * x + (force / stiffness) ** (1 / 1.2) + 1e-6 * rng.standard_normal(len(k))
    position = np.column_stack((x, np.zeros(len(k)), -inward))
    parts = cycles(position * (1, 1, 0), inward, force, 0.006)
    onsets = [onset((inward[one], force[one], x[one]), 1.2, 0.01) for one in parts]
    assert 50 <= len(parts) <= 60
    for one, begin in zip(parts, onsets, strict=True):
        assert begin is not None
        if not one.start <= 30 * per_cycle < one.stop:
            assert begin.slope == pytest.approx(0.2, abs=0.02)
            assert begin.at == pytest.approx(0.0, abs=0.001)
    assert not cycles(position * (1, 1, 0), inward, np.full(len(k), 1.2), 0.006)
