"""Readers of the bus and of text: messages, attachments, keys, tokens, chunks, options, scenarios, settings."""

import random
import struct
from collections.abc import Callable, Iterator, Sequence
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rosbags.interfaces import Nodetype

from palpate_bus.contract import contract
from palpate_bus.messages import RecordChunk, codec
from palpate_bus.messages.typestore import array_dtype
from palpate_bus.runtime.member import CHUNK_TYPE, unpack_chunk
from palpate_bus.settings import BusConfigError, Settings
from palpate_bus.wire.liveliness import parse_token
from palpate_bus.wire.rmw import AttachmentWriter, WireError, parse_key, topic_key, unpack
from palpate_bus.wire.zenoh_config import BusOptions
from palpate_models.scenario.load import ScenarioError, dump_scenario, load_scenario, scenario_names


class FuzzTarget(NamedTuple):
    """A function under test and its valid inputs."""

    name: str
    check: Callable[[bytes], bool]
    """Reads one input; returns True if it was accepted, False if it was refused with the documented error."""
    seeds: Callable[[random.Random], Sequence[bytes]]


class Broken(AssertionError):
    """A property does not hold for an accepted input."""


# -- messages


def _codecs() -> Iterator[FuzzTarget]:
    names = sorted({row.type for row in contract().topics.values()} | {row.type for row in contract().internal.values()})
    for name in names:
        yield FuzzTarget(f"codec:{name}", _codec_check(name), _payloads(name))


def _codec_check(name: str) -> Callable[[bytes], bool]:
    decode, encode = codec.decoder(name), codec.encoder(name)

    def check(data: bytes) -> bool:
        """Check that data is refused with CodecError, or that its canonical bytes are a fixed point, also for rosbags."""
        try:
            message = decode(data)
        except codec.CodecError:
            return False
        canonical = encode(message)
        if encode(decode(canonical)) != canonical:
            raise Broken(f"{name}: encoding the decoded message changes it")
        if bytes(codec.store.serialize_cdr(codec.store.deserialize_cdr(canonical, name), name)) != canonical:
            raise Broken(f"{name}: rosbags returns other bytes")
        return True

    return check


def _payloads(name: str) -> Callable[[random.Random], list[bytes]]:
    return lambda rng: [random_payload(name, rng) for _ in range(8)]


def random_payload(name: str, rng: random.Random) -> bytes:
    """Return a valid message of a type with random content, in CDR."""
    return codec.encode(_message(name, rng), name)


def _message(name: str, rng: random.Random) -> Any:
    definition = codec.store.get_msgdef(name)
    return definition.cls(**{field: _field(description, rng) for field, description in definition.fields})


def _field(description: Any, rng: random.Random) -> Any:
    kind, detail = description
    if kind == Nodetype.NAME:
        return _message(detail, rng)
    if kind == Nodetype.BASE:
        return _scalar(detail[0], rng)
    size = detail[1] if kind == Nodetype.ARRAY else rng.randrange(4)
    item_kind, item = detail[0]
    if item_kind == Nodetype.BASE and item[0] != "string":
        dtype = array_dtype(item[0])
        if item[0] == "bool":
            return np.array([rng.random() < 0.5 for _ in range(size)], dtype)
        return np.frombuffer(rng.randbytes(size * dtype.itemsize), dtype)
    return [_field(detail[0], rng) for _ in range(size)]


def _scalar(base: str, rng: random.Random) -> Any:
    if base == "string":
        return "".join(rng.choice("aZ09/_ -.äß€") for _ in range(rng.randrange(9)))
    if base == "bool":
        return rng.random() < 0.5
    if base in ("float32", "float64"):
        code = "<f" if base == "float32" else "<d"
        return float(struct.unpack(code, rng.randbytes(struct.calcsize(code)))[0])
    limits = np.iinfo({"byte": "int8", "char": "uint8"}.get(base, base))
    return rng.randint(int(limits.min), int(limits.max))


# -- attachment, keys, tokens, chunks, options


def _round_trip(
    name: str, read: Callable[[bytes], Any], write: Callable[[Any], bytes], refused: type[Exception], seeds: Sequence[bytes]
) -> FuzzTarget:
    """Return a target that checks that data is refused with `refused`, or that its value is equal after writing and reading."""

    def check(data: bytes) -> bool:
        try:
            value = read(data)
        except refused:
            return False
        if read(write(value)) != value:
            raise Broken(f"{name}: reading what was written changes it")
        return True

    return FuzzTarget(name, check, lambda _: seeds)


def _text(data: bytes) -> str:
    return data.decode("utf-8", "surrogateescape")


def _bytes(text: str) -> bytes:
    return text.encode("utf-8", "surrogateescape")


def _pack(value: tuple[int, int, bytes]) -> bytes:
    sequence, sent, gid = value
    return AttachmentWriter(gid).pack(sequence, sent)


_VARIABLES = ("PALPATE_LISTEN", "PALPATE_CONNECT", "PALPATE_ROUTER", "PALPATE_MODE", "PALPATE_LOWLATENCY", "PALPATE_TLS")


def _options(data: bytes) -> BusOptions:
    return BusOptions.from_settings(Settings.read(dict(zip(_VARIABLES, _text(data).split("\n"), strict=False))))


def _round_trips() -> Iterator[FuzzTarget]:
    yield _round_trip("attachment", unpack, _pack, WireError, [_pack((2**40 + n, 2**61, bytes(range(16)))) for n in range(3)])
    keys = [topic_key(topic, 3).encode() for topic in contract().topics.values()]
    yield _round_trip("key", lambda data: parse_key(_text(data)), lambda key: _bytes(str(key)), WireError, keys)
    node = "@ros2_lv/0/a1b2/0/0/NN/%/%/robot"
    endpoint = (
        "@ros2_lv/0/a1b2/0/3/MP/%/%/robot/%joint_states/sensor_msgs::msg::dds_::JointState_/RIHS01_" + 64 * "a" + "/::,1:,:,:,,"
    )
    tokens = [node.encode(), endpoint.encode()]
    yield _round_trip("token", lambda data: parse_token(_text(data)), lambda found: _bytes(found.token), WireError, tokens)
    options = [
        b"tcp/127.0.0.1:7501,unixsock-stream//run/a.sock\ntcp/a:1\ntcp/host:7447\npeer\n1", b"\n\ntls/h:1\nclient\n0\n/k",
    ]  # fmt: skip
    yield _round_trip("options", _options, _encode_options, BusConfigError, options)


def _encode_options(options: BusOptions) -> bytes:
    environment = options.to_env()
    return _bytes("\n".join(environment.get(name, "") for name in _VARIABLES))


def accepts(read: Callable[[bytes], object], refused: type[Exception]) -> Callable[[bytes], bool]:
    """Return the check of a reader that refuses with `refused`."""

    def check(data: bytes) -> bool:
        try:
            read(data)
        except refused:
            return False
        return True

    return check


def _chunk(data: bytes) -> None:
    _, messages = unpack_chunk(data)
    list(messages)


def _chunks(rng: random.Random) -> list[bytes]:
    topic, stamp = np.zeros(1, np.uint16), np.zeros(1, np.int64)
    sequence, length = np.zeros(1, np.uint32), np.array([2], np.uint32)
    message = RecordChunk("robot", 0, ["clock"], topic, stamp, sequence, length, np.zeros(2, np.uint8))
    return [codec.encode(message, CHUNK_TYPE), *(random_payload(CHUNK_TYPE, rng) for _ in range(3))]


CHUNK = FuzzTarget("chunk", accepts(_chunk, codec.CodecError), _chunks)


def _texts(_: random.Random) -> list[bytes]:
    folder = resources.files("palpate_models").joinpath("scenarios")
    return [folder.joinpath(f"{name}.yaml").read_bytes() for name in scenario_names()]


def _scenario(data: bytes) -> bool:
    """Check that data is refused with ScenarioError, or that a scenario is equal after writing and reading it."""
    file = Path("fuzz.yaml")
    file.write_bytes(data)
    try:
        scenario = load_scenario(str(file))
    except ScenarioError:
        return False
    file.write_text(dump_scenario(scenario), encoding="utf-8")
    if load_scenario(str(file)) != scenario:
        raise AssertionError("scenario: reading the written file changes it")
    return True


def _setting(data: bytes) -> None:
    load_scenario("healthy", data.decode("utf-8", "replace").split("\n"))


_SETTINGS = (
    b"exam.depth_m=0.008", b"exam.region_m=[0.06, 0.06]", b"phantom.lesions=[{centre_m: [0, 0], radii_m: [0.02, 0.02]}]",
    b"phantom.lesions.0.contrast=3", b"exam.region_m.1=0.1\nseed=4", b"camera.frames=10", b"errors=poor\nerrors.force.tare_n=0.3",
    b"phantom.breathing={kind: held, coughs_per_min: 2}", b"phantom.motion={kind: turn, at_s: 20}",
)  # fmt: skip


SCENARIO = FuzzTarget("scenario", _scenario, _texts)
SETTING = FuzzTarget("setting", accepts(_setting, ScenarioError), lambda _: _SETTINGS)


def bus_targets() -> list[FuzzTarget]:
    """Return a target for each reader of bytes from the bus, of options and of scenarios."""
    return [*_codecs(), *_round_trips(), CHUNK, SCENARIO, SETTING]
