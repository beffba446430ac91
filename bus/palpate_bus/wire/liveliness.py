"""Liveliness tokens of rmw_zenoh, so that `ros2 node list` and `ros2 topic info` show our services.

A token is a key that exists as long as its process:

    @ros2_lv/<domain>/<zid>/<node id>/<entity id>/<kind>/<enclave>/<namespace>/<node>[/<topic>/<type>/<hash>/<qos>]

with every `/` inside a part written `%`. Kinds are NN (node), MP (publisher), MS (subscription), SS and SC (service, client).
The GID of an entity, which every message's attachment carries, is the XXH3 128-bit hash of its token, low half first.

A role is a ROS node of that name. Sources: ros2/rmw_zenoh, `docs/design.md`, `rmw_zenoh_cpp/src/detail/liveliness_utils.cpp`
and `qos.cpp`; the numbers of the policies are those of ros2/rmw, `rmw/types.h`.
"""

from collections.abc import Iterable, Iterator
from enum import StrEnum
from itertools import count, product
from queue import Empty, SimpleQueue
from typing import Any, NamedTuple

import xxhash
import zenoh

from palpate_bus.contract import Qos, Topic
from palpate_bus.wire.rmw import GID_SIZE, WireError, dds_type, ros_type
from palpate_errors import restate

ADMIN_SPACE = "@ros2_lv"
_DEFAULT_DEPTH = 42  # RMW_ZENOH_DEFAULT_HISTORY_DEPTH
_PARTS_OF_NODE = 9
_PARTS_OF_ENDPOINT = 13


class EntityKind(StrEnum):
    """Kind of an entity of the ROS graph."""

    NODE = "NN"
    PUBLISHER = "MP"
    SUBSCRIPTION = "MS"
    SERVICE = "SS"
    CLIENT = "SC"


class Endpoint(NamedTuple):
    """Declaration of a publisher, subscription, service or client. `type` is the ROS name."""

    topic: str
    type: str
    type_hash: str
    qos: str


class Entity(NamedTuple):
    """An entity of the ROS graph, as in its token."""

    domain: int
    zid: str
    node_id: int
    entity_id: int
    kind: EntityKind
    node: str
    namespace: str = "/"
    enclave: str = "/"
    endpoint: Endpoint | None = None

    @property
    def token(self) -> str:
        """Key of the token."""
        parts = [str(self.domain), self.zid, str(self.node_id), str(self.entity_id), self.kind.value]
        parts += [self.enclave, self.namespace, self.node]
        if self.endpoint is not None:
            topic = "/" + self.endpoint.topic.strip("/")
            parts += [topic, dds_type(self.endpoint.type), self.endpoint.type_hash, self.endpoint.qos]
        return "/".join([ADMIN_SPACE, *(part.replace("/", "%") for part in parts)])

    @property
    def gid(self) -> bytes:
        """GID, 16 bytes."""
        return gid(self.token)


def gid(token: str) -> bytes:
    """Return the GID of the entity of a token."""
    return xxhash.xxh3_128_intdigest(token.encode()).to_bytes(GID_SIZE, "little")


def qos_token(qos: Qos) -> str:
    """Return a QoS class as in a token of rmw_zenoh, whose defaults stay empty.

    `<reliability>:<durability>:<history>,<depth>:<deadline>:<lifespan>:<liveliness>`; the last three are always defaults here.
    """
    reliability = "" if qos.reliability == "RELIABLE" else "2"
    durability = "1" if qos.transient_local else ""
    depth = "" if qos.depth == _DEFAULT_DEPTH else str(qos.depth)
    return f"{reliability}:{durability}:,{depth}:,:,:,,"


def parse_token(key: str) -> Entity:
    """Return the entity of a token's key. Raises WireError if the key is not a token."""
    parts = key.split("/")
    if len(parts) < _PARTS_OF_NODE or parts[0] != ADMIN_SPACE or not all(parts):
        raise WireError(f"not a liveliness token: {key!r}")
    _, domain, zid, node_id, entity_id, kind, enclave, namespace, node, *endpoint = parts
    with restate(ValueError, WireError, f"liveliness token {key!r}"):
        entity_kind = EntityKind(kind)
        numbers = int(domain), int(node_id), int(entity_id)
    described = None
    if entity_kind is not EntityKind.NODE:
        if len(parts) < _PARTS_OF_ENDPOINT:
            raise WireError(f"liveliness token {key!r} lacks topic, type, hash or QoS")
        topic, dds, type_hash, qos = endpoint[:4]
        described = Endpoint(topic.replace("%", "/").strip("/"), ros_type(dds), type_hash, qos)
    names = namespace.replace("%", "/"), enclave.replace("%", "/")
    return Entity(numbers[0], zid, numbers[1], numbers[2], entity_kind, node, *names, described)


class NodeTokens:
    """The tokens of one role: of its node, and of its publishers and subscriptions as they are added.

    They exist until `undeclare` or until the process ends.
    """

    def __init__(self, session: zenoh.Session, role: str, domain: int, ids: Iterator[int] | None = None) -> None:
        """`ids` gives ids to the entities, if the session has several nodes."""
        self._liveliness = session.liveliness()
        self._ids = count() if ids is None else ids
        number = next(self._ids)
        self.node = Entity(domain, str(session.zid()), number, number, EntityKind.NODE, role)
        self._tokens: list[Any] = [self._liveliness.declare_token(self.node.token)]

    def publisher(self, topic: Topic, qos: Qos) -> bytes:
        """Declare a publisher of a topic and return its GID, for the attachments."""
        return self._declare(EntityKind.PUBLISHER, topic, qos)

    def subscription(self, topic: Topic, qos: Qos) -> bytes:
        """Declare a subscription to a topic and return its GID."""
        return self._declare(EntityKind.SUBSCRIPTION, topic, qos)

    def _declare(self, kind: EntityKind, topic: Topic, qos: Qos) -> bytes:
        endpoint = Endpoint(topic.name, topic.type, topic.type_hash, qos_token(qos))
        node = self.node
        entity = Entity(node.domain, node.zid, node.node_id, next(self._ids), kind, node.node, endpoint=endpoint)
        self._tokens.append(self._liveliness.declare_token(entity.token))
        return entity.gid

    def undeclare(self) -> None:
        """Withdraw the tokens."""
        while self._tokens:
            self._tokens.pop().undeclare()


class GraphWatch:
    """Watches the tokens of a domain: present ones, and changes.

    zenoh's callback only puts samples into a queue; call `changes` to process them.
    """

    def __init__(self, session: zenoh.Session, domain: int) -> None:
        self._queue: SimpleQueue[zenoh.Sample] = SimpleQueue()
        self._subscriber: Any = session.liveliness().declare_subscriber(
            f"{ADMIN_SPACE}/{domain}/**", zenoh.handlers.Callback(self._queue.put, indirect=False), history=True
        )
        self.alive: dict[str, Entity] = {}
        """Entities by token."""
        self.garbage = 0
        """Number of invalid tokens."""
        self._seen: set[str] = set()

    def changes(self, timeout: float = 0.0) -> list[tuple[Entity, bool]]:
        """Return the changes since the last call, oldest first: (entity, True if it appeared, False if it vanished).

        Waits up to `timeout` [s] for the first change.
        """
        found: list[tuple[Entity, bool]] = []
        wait = timeout
        while True:
            try:
                sample = self._queue.get(timeout=wait) if wait > 0 else self._queue.get_nowait()
            except Empty:
                return found
            wait = 0.0
            token = str(sample.key_expr)
            appeared = sample.kind == zenoh.SampleKind.PUT
            try:
                entity = parse_token(token)
            except WireError:
                self.garbage += 1
                continue
            if appeared == (token in self.alive):
                continue  # received twice, over two links
            if appeared:
                self.alive[token] = entity
                self._seen.add(entity.node)
            else:
                del self.alive[token]
            found.append((entity, appeared))

    def roles(self) -> frozenset[str]:
        """Return the names of the present nodes, as of the last `changes`."""
        return frozenset(entity.node for entity in self.alive.values() if entity.kind is EntityKind.NODE)

    def gone(self) -> frozenset[str]:
        """Return the names of the nodes that have left, as of the last `changes`."""
        return frozenset(self._seen) - self.roles()

    def close(self) -> None:
        """Stop watching."""
        self._subscriber.undeclare()


def mismatches(entities: Iterable[Entity]) -> list[str]:
    """Return a text for each publisher and subscription of a topic that do not connect because type or hash differ."""
    endpoints = [(entity.kind, entity.node, entity.endpoint) for entity in entities if entity.endpoint is not None]
    publishers = [(node, end) for kind, node, end in endpoints if kind is EntityKind.PUBLISHER]
    subscriptions = [(node, end) for kind, node, end in endpoints if kind is EntityKind.SUBSCRIPTION]
    return sorted({
        f"topic {sent.topic}: {sender} publishes {sent.type} {sent.type_hash}, but {reader} expects {wanted.type} "
        f"{wanted.type_hash}; both need the same message definitions"
        for (sender, sent), (reader, wanted) in product(publishers, subscriptions)
        if sent.topic == wanted.topic and (sent.type, sent.type_hash) != (wanted.type, wanted.type_hash)
    })  # fmt: skip
