"""Wire format of rmw_zenoh in ROS 2 Jazzy: key expressions, the attachment of every message, and authentication tags.

A topic's key is `<domain>/<topic>/<DDS type>/<RIHS01 hash>`, for example
`0/ft/wrench/geometry_msgs::msg::dds_::WrenchStamped_/RIHS01_8dc3de...`. Publisher and subscriber connect only if all
four agree; `any_type_key` finds peers that differ only in type or hash.

The attachment is 33 bytes, or 41 with a tag, as zenoh's serializer writes (int64, int64, 16 bytes) since rmw_zenoh_cpp 0.2.4
(Jazzy):

| offset | size | field |
|---|---|---|
| 0 | 8 | sequence number, little-endian, from 1 per publisher |
| 8 | 8 | source time stamp [ns] |
| 16 | 1 | length of the GID, 16 |
| 17 | 16 | GID of the publisher (see `liveliness.gid`) |
| 33 | 8 | tag, if the run has a key and the contract requires one; not part of rmw_zenoh, ROS 2 ignores it |

Sources: ros2/rmw_zenoh, `docs/design.md` and, in `rmw_zenoh_cpp/src/detail/`, `attachment_helpers.cpp`,
`liveliness_utils.cpp` and `type_support_common.cpp`.

Only processes with the key of a run can send messages with a valid tag. A tag is BLAKE2s (RFC 7693) with the run's key, 8 bytes,
over the key expression, the attachment and the payload. It follows
rmw_zenoh's fields in the attachment, which ROS 2 ignores. The key is a file that only its owner can read (PALPATE_KEY);
`palpate run` makes one per run. The contract decides which messages carry a tag (`tagged`).
"""

import os
import re
import secrets
import struct
from functools import lru_cache
from hashlib import blake2s
from hmac import compare_digest
from pathlib import Path
from typing import NamedTuple

from palpate_bus.contract import Topic
from palpate_bus.messages.codec import type_hash
from palpate_bus.settings import BusConfigError
from palpate_errors import UserError, restate

TAG_SIZE = 8
"""Bytes; one guess in 1.8e19 is right."""
KEY_SIZE = 32


class Tagger:
    """Makes and checks the tags of messages on one key expression."""

    __slots__ = ("_begin",)

    def __init__(self, key: bytes, expression: str) -> None:
        self._begin = blake2s(expression.encode(), key=key, digest_size=TAG_SIZE)

    def tag(self, attachment: bytes, payload: bytes) -> bytes:
        """Return the tag of a message; `attachment` has rmw_zenoh's fields only."""
        mac = self._begin.copy()
        mac.update(attachment)
        mac.update(payload)
        return mac.digest()

    def holds(self, attachment: bytes, payload: bytes) -> bool:
        """Return True if an attachment ends with the tag of its message."""
        return compare_digest(attachment[-TAG_SIZE:], self.tag(attachment[:-TAG_SIZE], payload))


def make_key(file: Path) -> Path:
    """Write a new key to a file that is never readable to others. Raises OSError."""
    with os.fdopen(os.open(file, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as opened:
        opened.write(secrets.token_bytes(KEY_SIZE))
    return file


def read_key(file: Path | None) -> bytes | None:
    """Return the key in a file; None without a file. Raises BusConfigError if it is invalid or readable to others."""
    if file is None:
        return None
    with restate(OSError, BusConfigError, f"PALPATE_KEY is {file}: cannot be read"):
        key, mode = file.read_bytes(), file.stat().st_mode
    if mode & 0o077:
        raise BusConfigError(f"PALPATE_KEY is {file}: others may read it (mode {mode & 0o777:04o}); allowed is 0600")
    if len(key) != KEY_SIZE:
        raise BusConfigError(f"PALPATE_KEY is {file}: has {len(key)} bytes; a key has {KEY_SIZE}")
    return key


GID_SIZE = 16  # RMW_GID_STORAGE_SIZE
ATTACHMENT_SIZE = 8 + 8 + 1 + GID_SIZE
HELLO_SPACE = "palpate/hello"
"""Prefix of the keys on which edges are tested before the first tick."""

_ATTACHMENT = struct.Struct(f"<qqB{GID_SIZE}s")
_TYPE = re.compile(r"([a-z][a-z0-9_]*)::(msg|srv|action)::dds_::([A-Za-z][A-Za-z0-9_]*)_")
_HASH = re.compile(r"RIHS01_[0-9a-f]{64}")
_DOMAIN = re.compile(r"[0-9]{1,5}")
# chunks of a ROS topic name; internal topics have a role name, which may have a dash
_CHUNK = re.compile(r"[A-Za-z0-9_~.{}-]+")


class WireError(UserError):
    """A key, token or attachment is not one of rmw_zenoh."""


class TopicKey(NamedTuple):
    """The parts of a topic's key expression. `type` is the ROS name, e.g. `sensor_msgs/msg/JointState`."""

    domain: int
    topic: str
    type: str
    type_hash: str

    def __str__(self) -> str:
        return f"{self.domain}/{self.topic}/{dds_type(self.type)}/{self.type_hash}"


def dds_type(name: str) -> str:
    """Return the DDS name of a ROS type: `sensor_msgs/msg/JointState` becomes `sensor_msgs::msg::dds_::JointState_`.

    Raises WireError if `name` is not a ROS type name.
    """
    package, slash, rest = name.partition("/")
    kind, slash_2, base = rest.partition("/")
    dds = f"{package}::{kind}::dds_::{base}_"
    if not (slash and slash_2 and _TYPE.fullmatch(dds)):
        raise WireError(f"not a ROS type name: {name!r}; expected <package>/msg/<Name>")
    return dds


def ros_type(dds: str) -> str:
    """Return the ROS name of a DDS type, the inverse of `dds_type`. Raises WireError."""
    match = _TYPE.fullmatch(dds)
    if match is None:
        raise WireError(f"not a DDS type name: {dds!r}; expected <package>::msg::dds_::<Name>_")
    return "/".join(match.groups())


def message_key(topic: str, type_name: str, domain: int) -> str:
    """Return the key of a topic of a known message type; slashes around `topic` are dropped, as in rmw_zenoh."""
    if not 0 <= domain <= 65535:
        raise WireError(f"domain {domain} is outside 0..65535")
    return str(TopicKey(domain, topic.strip("/"), type_name, type_hash(type_name)))


def topic_key(topic: Topic, domain: int) -> str:
    """Return the key expression of a topic of the contract in a ROS domain."""
    return message_key(topic.name, topic.type, domain)


@lru_cache(maxsize=256)
def parse_key(key: str) -> TopicKey:
    """Return the parts of a key expression. Raises WireError if it does not have rmw_zenoh's form."""
    chunks = key.split("/")
    if len(chunks) < 4:
        raise WireError(f"key {key!r} has {len(chunks)} parts; expected <domain>/<topic>/<type>/<hash>")
    domain, *topic, dds, digest = chunks
    if not _DOMAIN.fullmatch(domain) or int(domain) > 65535:
        raise WireError(f"key {key!r}: {domain!r} is not a ROS domain")
    if not all(_CHUNK.fullmatch(chunk) for chunk in topic):
        raise WireError(f"key {key!r}: {'/'.join(topic)!r} is not a topic name")
    if not _HASH.fullmatch(digest):
        raise WireError(f"key {key!r}: {digest!r} is not a RIHS01 hash")
    return TopicKey(int(domain), "/".join(topic), ros_type(dds), digest)


def hello_key(key: str) -> str:
    """Return the key on which the producer of a key sends hellos; they are not ROS messages, so they have a key of their own."""
    domain, _, rest = key.partition("/")
    return f"{domain}/{HELLO_SPACE}/{rest}"


def any_type_key(topic: str, domain: int) -> str:
    """Return a key expression that matches a topic with any type and hash, to find peers whose definition differs."""
    return f"{domain}/{topic.strip('/')}/*/*"


class AttachmentWriter:
    """Packs the attachments of one publisher."""

    __slots__ = ("_gid",)

    def __init__(self, gid: bytes):
        if len(gid) != GID_SIZE:
            raise WireError(f"a GID has {GID_SIZE} bytes, not {len(gid)}")
        self._gid = bytes(gid)

    def pack(self, sequence: int, source_timestamp_ns: int) -> bytes:
        """Return the attachment of a message. Both numbers are signed 64-bit; raises struct.error if one is not."""
        return _ATTACHMENT.pack(sequence, source_timestamp_ns, GID_SIZE, self._gid)


def unpack(attachment: bytes | bytearray | memoryview) -> tuple[int, int, bytes]:
    """Return (sequence, source time stamp [ns], GID) of an attachment. Raises WireError if it is invalid."""
    if len(attachment) not in (ATTACHMENT_SIZE, ATTACHMENT_SIZE + TAG_SIZE):
        raise WireError(f"an attachment has {ATTACHMENT_SIZE} bytes, not {len(attachment)}")
    sequence, stamp, length, gid = _ATTACHMENT.unpack_from(attachment)
    if length != GID_SIZE:
        raise WireError(f"an attachment's GID has {GID_SIZE} bytes, not {length}")
    return sequence, stamp, gid
