"""Fuzzes everything that reads bytes or text from other processes and users.

    palpate fuzz --inputs 1000000     mutations of valid inputs, divided among the targets; equal seeds give equal inputs

A target is a callable on bytes. It returns if the input was refused with the documented error, or accepted consistently; any
exception is a find, which is printed with its input in hexadecimal. Write a test with it, then fix the cause.
"""

from __future__ import annotations

import random
import struct
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatch
from functools import partial
from importlib import resources
from pathlib import Path
from time import perf_counter, thread_time
from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype

from palpate_bus.contract import contract
from palpate_bus.messages import codec
from palpate_bus.messages.typestore import array_dtype
from palpate_bus.runtime.output import CHUNK_TYPE, unpack_chunk
from palpate_bus.settings import Settings
from palpate_bus.wire.liveliness import parse_token
from palpate_bus.wire.rmw import ATTACHMENT_SIZE, AttachmentWriter, WireError, parse_key, topic_key, unpack
from palpate_bus.wire.zenoh_config import BusConfigError, BusOptions
from palpate_models.scenario.load import ScenarioError, dump_scenario, load_scenario, scenario_names


@dataclass(frozen=True)
class FuzzTarget:
    """A function under test and its valid inputs."""

    name: str
    check: Callable[[bytes], None]
    seeds: Callable[[random.Random], Sequence[bytes]]


class Broken(AssertionError):
    """A property does not hold for an accepted input."""


# -- messages


def _codecs() -> Iterator[FuzzTarget]:
    rules = contract()
    names = sorted({row.type for row in rules.topics.values()} | {row.type for row in rules.internal.values()})
    for name in names:
        yield FuzzTarget(f"codec:{name}", _codec_check(name), partial(_payloads, name))


def _codec_check(name: str) -> Callable[[bytes], None]:
    decode, encode = codec.decoder(name), codec.encoder(name)

    def check(data: bytes) -> None:
        """Check that data is refused with CodecError, or that its canonical bytes are a fixed point, also for rosbags."""
        try:
            message = decode(data)
        except codec.CodecError:
            return
        canonical = encode(message)
        if encode(decode(canonical)) != canonical:
            raise Broken(f"{name}: encoding the decoded message changes it")
        if bytes(codec.store.serialize_cdr(codec.store.deserialize_cdr(canonical, name), name)) != canonical:
            raise Broken(f"{name}: rosbags returns other bytes")

    return check


def _payloads(name: str, rng: random.Random) -> list[bytes]:
    return [random_payload(name, rng) for _ in range(8)]


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


def _attachment(data: bytes) -> None:
    try:
        sequence, sent, gid = unpack(data)
    except WireError:
        return
    if len(data) != ATTACHMENT_SIZE or AttachmentWriter(gid).pack(sequence, sent) != data:
        raise Broken("attachment: packing the unpacked values changes it")


ATTACHMENT = FuzzTarget(
    "attachment", _attachment, lambda rng: [AttachmentWriter(rng.randbytes(16)).pack(rng.randrange(2**62), rng.randrange(2**62))]
)


def _key(data: bytes) -> None:
    text = data.decode("utf-8", "surrogateescape")
    try:
        key = parse_key(text)
    except WireError:
        return
    if parse_key(str(key)) != key:
        raise Broken("key: parsing the written text changes it")


KEY = FuzzTarget("key", _key, lambda _: [topic_key(topic, 3).encode() for topic in contract().topics.values()])


def _token(data: bytes) -> None:
    try:
        entity = parse_token(data.decode("utf-8", "surrogateescape"))
    except WireError:
        return
    if parse_token(entity.token) != entity:
        raise Broken("token: parsing the written text changes it")


_ENDPOINT = (
    "@ros2_lv/0/a1b2/0/3/MP/%/%/robot/%joint_states/sensor_msgs::msg::dds_::JointState_/RIHS01_" + 64 * "a" + "/::,1:,:,:,,"
)
TOKEN = FuzzTarget("token", _token, lambda _: [b"@ros2_lv/0/a1b2/0/0/NN/%/%/robot", _ENDPOINT.encode()])


def _chunk(data: bytes) -> None:
    try:
        _, messages = unpack_chunk(data)
        list(messages)
    except codec.CodecError:
        return


CHUNK = FuzzTarget("chunk", _chunk, lambda rng: [random_payload(CHUNK_TYPE, rng) for _ in range(4)])


_VARIABLES = ("PALPATE_LISTEN", "PALPATE_CONNECT", "PALPATE_ROUTER", "PALPATE_MODE", "PALPATE_LOWLATENCY", "PALPATE_TLS")


def _options(data: bytes) -> None:
    words = data.decode("utf-8", "surrogateescape").split("\n")
    try:
        options = BusOptions.from_settings(Settings.read(dict(zip(_VARIABLES, words, strict=False))))
    except BusConfigError:
        return
    if BusOptions.from_settings(Settings.read(options.to_env())) != options:
        raise Broken("options: their environment yields other options")


OPTIONS = FuzzTarget(
    "options",
    _options,
    lambda _: [b"tcp/127.0.0.1:7501,unixsock-stream//run/a.sock\ntcp/a:1\ntcp/host:7447\npeer\n1", b"\n\ntls/h:1\nclient\n0\n/k"],
)


_FOLDER = tempfile.TemporaryDirectory(prefix="palpate-fuzz-")


def _texts(_: random.Random) -> list[bytes]:
    folder = resources.files("palpate_models").joinpath("scenarios")
    return [folder.joinpath(f"{name}.yaml").read_bytes() for name in scenario_names()]


def _scenario(data: bytes) -> None:
    """Check that data is refused with ScenarioError, or that a scenario is equal after writing and reading it."""
    file = Path(_FOLDER.name) / "fuzz.yaml"
    file.write_bytes(data)
    try:
        scenario = load_scenario(str(file))
    except ScenarioError:
        return
    file.write_text(dump_scenario(scenario), encoding="utf-8")
    if load_scenario(str(file)) != scenario:
        raise AssertionError("scenario: reading the written file changes it")


def _setting(data: bytes) -> None:
    try:
        load_scenario("healthy", data.decode("utf-8", "replace").split("\n"))
    except ScenarioError:
        return


_SETTINGS = (
    b"exam.depth_m=0.008", b"exam.region_m=[0.06, 0.06]", b"phantom.lesions=[{centre_m: [0, 0], radii_m: [0.02, 0.02]}]",
    b"phantom.lesions.0.contrast=3", b"exam.region_m.1=0.1\nseed=4", b"camera.frames=10", b"errors=poor\nerrors.force.tare_n=0.3",
    b"phantom.breathing={kind: held, coughs_per_min: 2}", b"phantom.motion={kind: turn, at_s: 20}",
)  # fmt: skip


SCENARIO = FuzzTarget("scenario", _scenario, _texts)
SETTING = FuzzTarget("setting", _setting, lambda _: _SETTINGS)


SLOW_S = 1.0
"""Processor time above which an input is a find, since it would delay a service."""
KEPT = 64
"""Inputs per target that are kept for splicing."""
_EDGES = (b"\xff\xff\xff\xff", b"\0\0\0\0", b"\xff\xff\xff\x7f", b"\0\0\0\x80", b"\1\0\0\0", b"\0\0\xf0\x7f")


@dataclass
class Find:
    """An input that broke a target."""

    target: str
    data: bytes
    error: str


@dataclass
class FuzzCampaign:
    """Results of a campaign."""

    seed: int
    inputs: dict[str, int] = field(default_factory=dict)
    finds: list[Find] = field(default_factory=list)
    seconds: float = 0.0


def mutate(data: bytes, rng: random.Random, others: Sequence[bytes]) -> bytes:
    """Return data with one to four random changes: bits, bytes, lengths, cuts, copies, and pieces of other inputs."""
    changed = bytearray(data)
    for _ in range(rng.randint(1, 4)):
        at = rng.randrange(len(changed) + 1)
        kind = rng.randrange(7)
        if kind == 0 and changed:
            changed[at % len(changed)] ^= 1 << rng.randrange(8)
        elif kind == 1 and changed:
            changed[at % len(changed)] = rng.randrange(256)
        elif kind == 2:
            at -= at % 4
            changed[at : at + 4] = rng.choice(_EDGES)
        elif kind == 3:
            del changed[at:]
        elif kind == 4:
            changed[at:at] = rng.randbytes(rng.randint(1, 8))
        elif kind == 5:
            end = min(at + rng.randint(1, 16), len(changed))
            changed[at:at] = changed[at:end]
        else:
            other = rng.choice(others)
            cut = rng.randrange(len(other) + 1)
            changed[at:] = other[cut:]
    return bytes(changed)


def attempt(target: FuzzTarget, data: bytes, slow_s: float = SLOW_S) -> Find | None:
    """Run one input; return a find or None."""
    begin = thread_time()
    try:
        target.check(data)
    except Exception as error:
        return Find(target.name, data, f"{type(error).__name__}: {error}")
    took = thread_time() - begin
    return Find(target.name, data, f"took {took:.1f} s of processor time") if took > slow_s else None


def campaign(
    chosen: Sequence[FuzzTarget],
    inputs: int,
    seed: int = 0,
    progress: Callable[[int, int, str], None] = lambda *_: None,
    most: int = 100,
    slow_s: float = SLOW_S,
) -> FuzzCampaign:
    """Run `inputs` inputs, divided among the targets. A target stops after `most` finds; one of each kind is kept.

    Calls `progress` after each target with the number of finished targets, the number of all, and the result as text.
    """
    done = FuzzCampaign(seed)
    begin = perf_counter()
    for index, target in enumerate(chosen):
        rng = random.Random(f"{seed} {target.name}")
        pool = list(target.seeds(rng))
        share = inputs // len(chosen) + (index < inputs % len(chosen))
        found = 0
        mine: list[Find] = []
        for number in range(share):
            data = pool[number] if number < len(pool) else mutate(rng.choice(pool), rng, pool)
            if number % 997 == 0:
                pool[rng.randrange(len(pool))] = data  # so that changes accumulate
                pool += target.seeds(rng)[: max(KEPT - len(pool), 0)]
            find = attempt(target, data, slow_s)
            if find is None:
                continue
            found += 1
            if find.error.partition(":")[0] not in {other.error.partition(":")[0] for other in mine}:
                mine.append(find)
            if found >= most:
                break
        done.finds += mine
        done.inputs[target.name] = share
        progress(index + 1, len(chosen), f"{target.name}: {share} inputs, {found} finds")
    done.seconds = perf_counter() - begin
    return done


def all_targets() -> list[FuzzTarget]:
    """Return all targets: readers of the bus and of scenarios."""
    return [*_codecs(), ATTACHMENT, KEY, TOKEN, CHUNK, OPTIONS, SCENARIO, SETTING]


def choose(patterns: Sequence[str]) -> list[FuzzTarget]:
    """Return the targets whose names match a pattern, all without patterns. Raises ValueError for one without a match."""
    known = all_targets()
    for pattern in patterns:
        if not any(fnmatch(target.name, pattern) for target in known):
            raise ValueError(f"no target {pattern!r}; targets are {', '.join(target.name for target in known)}")
    return [target for target in known if not patterns or any(fnmatch(target.name, p) for p in patterns)]
