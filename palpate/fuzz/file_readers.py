"""Readers of files: each target writes its input to the working folder, which is a temporary one, and reads it."""

import io
import json
import random
import shutil
import zipfile
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from mcap.writer import CompressionType, Writer
from trimesh import Trimesh
from trimesh.exchange.obj import export_obj
from trimesh.exchange.ply import export_ply
from trimesh.exchange.stl import export_stl, export_stl_ascii

from palpate.fuzz.bus_readers import FuzzTarget, accepts, random_payload
from palpate.recording.read import read_recording
from palpate.report.evidence import FILE, read_evidence, write_evidence
from palpate.report.page import read_report
from palpate.report.rows import DepthRow, Report
from palpate.run.processes import read_processes
from palpate.study.spec import load_study
from palpate_bus import implementations
from palpate_bus.contract import contract
from palpate_bus.messages import codec
from palpate_bus.messages.typestore import CodecError, definition_hash
from palpate_bus.recordings import SCENARIO, open_recording
from palpate_bus.settings import KEPT_EVERY
from palpate_conductor.collector import Collected
from palpate_errors import UserError
from palpate_fmu.reading import DESCRIPTION, binary_folders, read_description, read_variables
from palpate_inputs import parse_json
from palpate_models.numerics.frames import Array
from palpate_models.patient.mesh import load_mesh
from palpate_models.scenario.load import FELT, Checkpoint, read_checkpoint
from palpate_recorder.recover import recover
from palpate_tissue.backends.fmu.wiring import load_map

TOPIC = "joint_states"


def _target(
    name: str, file: str, read: Callable[[Path], object], seeds: Sequence[bytes], *, refused: type[Exception] = UserError
) -> FuzzTarget:
    def write_and_read(data: bytes) -> None:
        path = Path(file)
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(data)
        read(path)

    return FuzzTarget(name, accepts(write_and_read, refused), lambda _: seeds)


# -- meshes

_PLATE = Trimesh([(-0.2, -0.3, 0.0), (0.2, -0.3, 0.0), (0.2, 0.3, 0.0), (-0.2, 0.3, 0.0)], [(0, 1, 2), (0, 2, 3)], process=False)
_MESHES = {
    "obj-text": export_obj(_PLATE).encode(),
    "stl-binary": export_stl(_PLATE),
    "stl-text": export_stl_ascii(_PLATE).encode(),
    "ply-binary": export_ply(_PLATE),
    "ply-text": export_ply(_PLATE, encoding="ascii"),
}

# -- FMUs

_ARRAY = (
    '<?xml version="1.0"?><fmiModelDescription fmiVersion="3.0" modelName="m" instantiationToken="g">'
    '<CoSimulation modelIdentifier="m"/><DefaultExperiment startTime="0"/><ModelVariables>'
    '<Float64 name="time" valueReference="0" causality="independent" variability="continuous"/>'
    '<UInt64 name="n" valueReference="1" causality="structuralParameter" variability="fixed" start="3"/>'
    '<Float64 name="x" valueReference="2" causality="output" variability="continuous" unit="m" min="0">'
    '<Dimension valueReference="1"/><Dimension start="2"/></Float64></ModelVariables>'
    '<ModelStructure><Output valueReference="2"/></ModelStructure></fmiModelDescription>'
)
_SCALARS = (
    '<?xml version="1.0"?><fmiModelDescription fmiVersion="2.0" modelName="m" guid="g"><CoSimulation modelIdentifier="m"/>'
    '<ModelVariables><ScalarVariable name="x[1,1]" valueReference="0" causality="output"><Real start="1"/></ScalarVariable>'
    '<ScalarVariable name="x[1,2]" valueReference="1" causality="output"><Real unit="m"/></ScalarVariable></ModelVariables>'
    '<ModelStructure><Outputs><Unknown index="1" dependencies="2"/></Outputs></ModelStructure></fmiModelDescription>'
)


def _fmu(description: bytes) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(DESCRIPTION, description)
        archive.writestr("binaries/x86_64-linux/m.so", b"library")
    return file.getvalue()


def _read_fmu(path: Path) -> None:
    description, _ = read_description(path)
    read_variables(description)
    binary_folders(path)


def _read_described(path: Path) -> None:
    packed = Path("described.fmu")
    packed.write_bytes(_fmu(path.read_bytes()))
    _read_fmu(packed)


_MAP = b"""role: tissue
frame: abdomen
inputs: {sim/tool_state: {indenter_position: {field: pose.position, kind: point}, indenter_radius: radius}}
outputs: {sim/contact_wrench: {wrench.force: {variable: contact_force, kind: vector}, area: {value: 1.0}}}
parameters: {phantom: [1, 2]}
start_s: 0.5
"""

# -- recordings


def recording_bytes(compression: CompressionType, whole: bool) -> bytes:
    """Return a small recording; one that is not `whole` has neither checksums nor an index."""
    file, row, rng = io.BytesIO(), contract().topics[TOPIC], random.Random(1)
    writer = Writer(
        file, chunk_size=400, compression=compression, enable_crcs=whole, use_statistics=whole, use_summary_offsets=whole
    )
    writer.start(profile="ros2")
    definition = codec.store.generate_msgdef(row.type, ros_version=2)[0].encode()
    schema = writer.register_schema(row.type, "ros2msg", definition)
    qos = "- history: keep_last\n  depth: 5\n  durability: volatile\n"
    known = {"offered_qos_profiles": qos, "topic_type_hash": row.type_hash, KEPT_EVERY: "10"}
    channel = writer.register_channel(f"/{TOPIC}", "cdr", schema, known)
    for number in range(4):
        writer.add_message(channel, 1_000_000 * number, random_payload(row.type, rng), 0, number)
    writer.add_attachment(0, 0, SCENARIO, "text/yaml", b"name: a\n")
    writer.finish()
    return file.getvalue()


_RECORDINGS = tuple(
    recording_bytes(compression, whole)
    for compression in (CompressionType.NONE, CompressionType.ZSTD, CompressionType.LZ4)
    for whole in (True, False)
)


def _read_recording(path: Path) -> None:
    recording = open_recording(path)
    for name, kind in recording.types.items():
        kind.difference(contract().topics.get(name, contract().topics[TOPIC]))
    for _ in recording.messages(list(recording.types)):
        pass


def _read_bag(path: Path) -> None:
    (path.parent / "a.mcap").write_bytes(_RECORDINGS[0])
    open_recording(path.parent)


def _recover(path: Path) -> None:
    shutil.rmtree("input_recovered", ignore_errors=True)
    recover(path)


def _define(path: Path) -> None:
    definition_hash("palpation_msgs/msg/Fuzzed", path.read_text(encoding="utf-8", errors="replace"))


def _evidence() -> bytes:
    with TemporaryDirectory() as folder:
        write_evidence(Path(folder, FILE), Collected(), run="fuzz")
        return Path(folder, FILE).read_bytes()


# -- recordings of other robots

_TABLE_MAPPING = b"""table: {time: t, position: [x, y, z], force: [fx, fy, fz]}
units: {length: mm}
tool: {radius_m: 0.01, point: tip}
body: {anatomy: none, pose: {xyz_m: [0, 0, 0.1]}}
"""
_BAG_MAPPING = b"""topics: {wrench: wrench, pose: {topic: joints, urdf: arm.urdf, frame: tip}}
tool: {radius_m: 0.01}
"""
_ARM = b"""<robot name="arm"><link name="base"/><link name="tip"/>
<joint name="j" type="prismatic"><parent link="base"/><child link="tip"/><axis xyz="0 0 1"/>
<limit effort="1" velocity="1" lower="-1" upper="1"/></joint></robot>
"""


def _presses() -> Iterator[tuple[float, Array, Array]]:
    """Yield time [s], position of the tool [m] and force on it [N] of two presses."""
    rng = np.random.default_rng(1)
    for k in range(120):
        phase = k % 60 / 30 - 1
        depth = 0.008 * (1 - abs(phase)) - 0.003
        force = np.array([0.0, 0.0, max(depth, 0.0) * 800])
        yield 0.02 * k, np.array([0.02 * (k // 60), 0.0, -depth]), force + rng.normal(0, 0.01, 3)


def _table() -> bytes:
    rows = (
        f"{t:.2f},{x * 1e3:.2f},{y:.0f},{z * 1e3:.3f},{fx:.3f},{fy:.3f},{fz:.3f}" for t, (x, y, z), (fx, fy, fz) in _presses()
    )
    return "\n".join(("t,x,y,z,fx,fy,fz", *rows)).encode()


def _bag() -> bytes:
    """Return a recording of wrenches and joint states of a prismatic joint along z."""
    file, make = io.BytesIO(), codec.store.types
    writer = Writer(file, chunk_size=4000, compression=CompressionType.NONE, enable_crcs=False)
    writer.start(profile="ros2")
    channels = {}
    for topic, kind in (("wrench", "geometry_msgs/msg/WrenchStamped"), ("joints", "sensor_msgs/msg/JointState")):
        definition = codec.store.generate_msgdef(kind, ros_version=2)[0].encode()
        channels[topic] = writer.register_channel(f"/{topic}", "cdr", writer.register_schema(kind, "ros2msg", definition))
    vector, none = make["geometry_msgs/msg/Vector3"], np.empty(0)
    for t, (_, _, z), force in _presses():
        header = make["std_msgs/msg/Header"](make["builtin_interfaces/msg/Time"](int(t), int(t % 1 * 1e9)), "tip")
        wrench = make["geometry_msgs/msg/Wrench"](vector(*force.tolist()), vector(0.0, 0.0, 0.0))
        sent = {
            "wrench": make["geometry_msgs/msg/WrenchStamped"](header, wrench),
            "joints": make["sensor_msgs/msg/JointState"](header, ["j"], np.array([z]), none, none),
        }
        for topic, message in sent.items():
            payload = bytes(codec.store.serialize_cdr(message, message.__msgtype__))
            writer.add_message(channels[topic], int(t * 1e9), payload, int(t * 1e9))
    writer.finish()
    return file.getvalue()


def _foreign(path: Path, *, table: bool) -> None:
    """Read a table or a bag, or either with this mapping or arm."""
    files = {"input.csv" if table else "input.mcap": _table() if table else _bag(), "arm.urdf": _ARM}
    files["mapping.yaml"] = _TABLE_MAPPING if table else _BAG_MAPPING
    for name, content in files.items():
        if name != path.name:
            Path(name).write_bytes(content)
    read_recording(next(iter(files)), "mapping.yaml")


# -- arrays and text


def _checkpoint(stored: bool) -> bytes:
    rows: dict[str, Any] = {name: np.zeros((2, 3) if name in ("position", "normal", "velocity") else 2) for name in FELT}
    made = Checkpoint(rows, np.zeros((1, 2)), np.zeros((3, 3)), 1)
    if not stored:
        return made.bytes()
    file = io.BytesIO()
    np.savez(file, left=made.left, surface=made.surface, strokes=np.array(1), **rows)
    return file.getvalue()


_STUDY = b"""name: mine
populations:
  healthy: {scenario: person, number: {test: 20}}
  lumps: {scenario: person, number: {test: 20}, lumps: {radius_m: [0.008, 0.020], contrast: {grid: [2, 4, 8]}}}
errors: {typical: typical}
methods: {palpate: {}, mine: {services: {assessment: mine.py}}}
"""
_SERVICE = b"""from palpate_bus.service import Service


def create(scenario):
    return Service()
"""
_COMPOSE = b"""services:
  robot: {image: palpate, command: [python, -m, palpate.service, robot], environment: {PALPATE_MODE: peer}}
  tissue:
    command: [python]
"""
_DEPTHS = dict.fromkeys(DepthRow.model_fields, 0.001)
_REPORT = json.dumps({
    **dict.fromkeys(Report.model_fields, 1), "run": "a", "scenario": "lump", "clean_world": False, "runtime": "composed",
    "platform": {}, "run_hash": None, "digests": {}, "failure": None, "failure_code": None, "lost": {"camera": 3.5},
    "depth": _DEPTHS, "assessed": True, "findings": [], "candidates": [], "unassessed_m2": {}, "truth": None, "scores": None,
    "blame": {}, "recorded": None, "services": {"search": {"facts": {"presses": 3}}},
}).encode()  # fmt: skip


def file_targets() -> Iterator[FuzzTarget]:
    """Yield a target for each reader of files."""
    for name, seed in _MESHES.items():
        yield _target(f"mesh:{name}", f"input.{name.partition('-')[0]}", lambda path: load_mesh(path, 0.1), (seed,))
    described = (_ARRAY.encode(), _SCALARS.encode())
    yield _target("fmu:archive", "input.fmu", _read_fmu, tuple(map(_fmu, described)))
    yield _target("fmu:description", "input.xml", _read_described, described)
    yield _target("fmu:map", "input.yaml", load_map, (_MAP,))
    yield _target("recording:mcap", "input.mcap", _read_recording, _RECORDINGS)
    yield _target("recording:recover", "input.mcap", _recover, _RECORDINGS, refused=ValueError)
    listed = b"rosbag2_bagfile_information: {version: 5, compression_mode: '', relative_file_paths: [a.mcap]}\n"
    yield _target("recording:bag", "bag/metadata.yaml", _read_bag, (listed,))
    definitions = [codec.store.generate_msgdef(row.type, ros_version=2)[0].encode() for row in contract().topics.values()]
    yield _target("recording:definition", "input.msg", _define, definitions, refused=CodecError)
    yield _target("foreign:table", "input.csv", partial(_foreign, table=True), (_table(),))
    yield _target("foreign:bag", "input.mcap", partial(_foreign, table=False), (_bag(),))
    yield _target("foreign:mapping", "mapping.yaml", partial(_foreign, table=True), (_TABLE_MAPPING,))
    yield _target("foreign:urdf", "arm.urdf", partial(_foreign, table=False), (_ARM,))
    yield _target("results:evidence", FILE, lambda path: read_evidence(path.parent), (_evidence(),))
    yield _target("results:report", "report.json", lambda path: read_report(path.parent), (_REPORT,))
    yield _target("results:checkpoint", "input.npz", read_checkpoint, (_checkpoint(True), _checkpoint(False)))
    yield _target("json", "input.json", lambda path: parse_json(path.read_bytes(), "input"), (_REPORT,))
    yield _target("study", "input.yaml", lambda path: load_study(str(path)).error_levels(), (_STUDY,))
    yield _target("service-file", "input.py", lambda path: implementations.kind("assessment").check(f"./{path}"), (_SERVICE,))
    yield _target("compose", "input.yaml", partial(read_processes, roles=("robot", "tissue")), (_COMPOSE,))
