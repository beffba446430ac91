"""zenoh publishers and subscriptions with rmw_zenoh's attachment; garbage is counted and dropped.

Callbacks only put samples into the subscription's queue, which the service's thread empties.
"""

from collections.abc import Callable, Collection
from itertools import count
from queue import Empty, SimpleQueue
from time import monotonic, time_ns
from typing import Any, NamedTuple, Protocol

import zenoh

from palpate_bus.contract import Qos, Topic, contract
from palpate_bus.messages import CodecError, codec
from palpate_bus.settings import Settings
from palpate_bus.wire.rmw import AttachmentWriter, Tagger, WireError, hello_key, parse_key, read_key, unpack

HELLO = 0
"""Sequence number of the empty message that tests an edge before the first tick; data starts at 1."""


def subscribe(session: zenoh.Session, key: str, handler: Any, *, history: bool = False) -> Any:
    """Declare a subscriber; with `history` it also receives the earlier messages of a latched topic."""
    if not history:
        return session.declare_subscriber(key, handler)
    late = zenoh.ext.HistoryConfig(detect_late_publishers=True)
    return zenoh.ext.declare_advanced_subscriber(session, key, handler, history=late)


class ReceivedSample(NamedTuple):
    """A message received on a subscription."""

    sequence: int
    sent: int
    """Source time [ns], wall clock."""
    payload: bytes


class Sender(Protocol):
    """Sends on a topic."""

    def put(self, payload: bytes, sequence: int) -> None:
        """Send a message."""

    def hello(self) -> None:
        """Send the empty message that tests the edge."""


class Publisher:
    """Sends on one key with the QoS of the contract."""

    def __init__(
        self,
        session: zenoh.Session,
        key: str,
        qos: Qos,
        gid: bytes,
        now: Callable[[], int] = time_ns,
        tagger: Tagger | None = None,
    ) -> None:
        """`now` returns the source time [ns] of a message; with a `tagger` messages are tagged."""
        self.key = key
        self._session = session
        self._now = now
        options: dict[str, Any] = {"priority": getattr(zenoh.Priority, qos.priority), "express": qos.express}
        options["congestion_control"] = getattr(zenoh.CongestionControl, qos.congestion)
        options["reliability"] = getattr(zenoh.Reliability, qos.reliability)
        if qos.transient_local:
            self._publisher: Any = zenoh.ext.declare_advanced_publisher(
                session, key, cache=zenoh.ext.CacheConfig(qos.depth), publisher_detection=True, **options
            )
        else:
            self._publisher = session.declare_publisher(key, **options)
        self._pack = AttachmentWriter(gid).pack
        self._tagger = tagger

    def put(self, payload: bytes, sequence: int) -> None:
        """Send a message."""
        self._publisher.put(payload, attachment=self._attachment(sequence, payload))

    def hello(self) -> None:
        """Send the empty message that tests the edge."""
        self._session.put(hello_key(self.key), b"", attachment=self._attachment(HELLO, b""))

    def _attachment(self, sequence: int, payload: bytes) -> bytes:
        attachment = self._pack(sequence, self._now())
        return attachment if self._tagger is None else attachment + self._tagger.tag(attachment, payload)


class TagCheck:
    """Accepts the messages of one key by their tags.

    On an open topic only messages with `tagged_values` need one, and each must be newer than the last, so none can be replayed.
    """

    def __init__(self, tagger: Tagger, topic: Topic | None) -> None:
        """`topic`: the row of the contract; None for messages of the runtime."""
        self._tagger = tagger
        self._decode = codec.decoder(topic.type) if topic is not None and topic.open else None
        self._values = {} if topic is None else topic.tagged_values
        self._newest = time_ns()

    def is_valid(self, attachment: bytes, sent: int, payload: bytes) -> bool:
        """Return True if a message needs no tag or has a valid one; `sent` is its source time [ns]."""
        if self._decode is None:
            return self._tagger.holds(attachment, payload)
        message = try_decode(self._decode, payload)
        if message is None or not any(getattr(message, field) in values for field, values in self._values.items()):
            return True
        if sent <= self._newest or not self._tagger.holds(attachment, payload):
            return False
        self._newest = sent
        return True


class Subscription:
    """Receives on one key.

    Only messages of the sender of the first hello are accepted; before a hello, those of the first sender. Dropped messages are
    counted: without a valid attachment in `garbage`, of another sender in `foreign`, and where messages carry tags, without a
    valid one in `forged`. An open topic accepts messages of every sender that can be decoded.
    """

    def __init__(
        self,
        session: zenoh.Session,
        key: str,
        history: bool = False,
        decode: Callable[[bytes], object] | None = None,
        tags: TagCheck | None = None,
    ) -> None:
        """Subscribe.

        `history` also delivers earlier messages of a latched topic; `decode` opens the topic to all senders; `tags` decides which
        messages need a tag.
        """
        self.key = key
        self._decode = decode
        self.garbage = 0
        self.foreign = 0
        self.forged = 0
        self._tags = tags
        self.hello_received = False
        self.replaced = False
        """Set when a hello reveals a new sender; cleared by the reader."""
        self._gid: bytes | None = None
        self._retired: bytes | None = None
        self._queue: SimpleQueue[zenoh.Sample] = SimpleQueue()
        handler = zenoh.handlers.Callback(self._queue.put, indirect=False)
        self._subscriber = subscribe(session, key, handler, history=history)
        # declared last: a producer whose hello arrives here has discovered both
        self._hellos: Any = session.declare_subscriber(hello_key(key), handler)

    def get(self, timeout: float | None) -> ReceivedSample | None:
        """Return the next message, or None after `timeout` [s]; a timeout of 0 does not wait."""
        end = monotonic() + timeout if timeout else 0.0
        while True:
            left = end - monotonic() if timeout else 0.0  # dropped messages do not extend the timeout
            if left <= 0 and self._queue.empty():  # this is the only reader; far cheaper than the exception
                return None
            try:
                raw = self._queue.get(timeout=left) if left > 0 else self._queue.get_nowait()
            except Empty:
                return None
            sample = self._unwrap(raw)
            if sample is not None:
                return sample

    def _unwrap(self, raw: zenoh.Sample) -> ReceivedSample | None:
        """Return the message of a sample, or None if it is dropped."""
        try:
            attachment: bytes = raw.attachment.to_bytes()  # type: ignore[union-attr]  # a missing one is an AttributeError
            sequence, sent, gid = unpack(attachment)
        except (WireError, AttributeError):
            self.garbage += 1
            return None
        payload = raw.payload.to_bytes()
        if self._tags is not None and not self._tags.is_valid(attachment, sent, payload):
            self.forged += 1
            return None
        if gid != self._gid:
            is_hello = sequence == HELLO and not payload and not self.hello_received  # only senders of this run send a hello
            if self._decode is None and (gid == self._retired or (self._gid is not None and not is_hello)):
                self.foreign += 1
                return None
            self.replaced = self._gid is not None and self._decode is None
            self._gid = gid
        if not payload:
            self.hello_received = self.hello_received or sequence == HELLO
            return None
        # some clients of rmw_zenoh number their messages from 0
        if sequence == HELLO if self._decode is None else try_decode(self._decode, payload) is None:
            self.garbage += 1
            return None
        return ReceivedSample(sequence, sent, payload)

    @property
    def suspicion(self) -> str:
        """A text if there are messages of a wrong sender; else empty."""
        if self.forged:
            return "dropping messages with an invalid authentication tag: forged, or the sender lacks the run key"
        if self.foreign and self._retired is None:
            return "dropping messages of a second sender"
        return ""

    def hand_over(self) -> None:
        """Accept the next new sender in place of this one, whose further messages are dropped."""
        if self._gid is not None:
            self._retired, self._gid = self._gid, None

    def close(self) -> None:
        """Undeclare the subscribers."""
        self._hellos.undeclare()
        self._subscriber.undeclare()


def dropped_by(subscriptions: Collection[Subscription]) -> dict[str, int]:
    """Return the numbers of messages that subscriptions dropped: `garbage`, `foreign` ones of another sender, `forged` ones."""
    return {kind: sum(getattr(one, kind) for one in subscriptions) for kind in ("garbage", "foreign", "forged")}


class Transport:
    """Publishers, subscriptions and wall clock of the members of one session.

    It is passed to the runtimes, so that a test can use one that drops, changes or delays messages.
    """

    def __init__(self, session: zenoh.Session) -> None:
        self.session = session
        settings = Settings.read()
        self.key = read_key(settings.key)
        """Key of the run, or None."""
        self._tags = settings.tags is not False
        self.ids = count()
        """Ids of the entities that members declare."""

    def now(self) -> int:
        """Return the wall time [ns]."""
        return time_ns()

    def publisher(self, topic: str, key: str, qos: Qos, gid: bytes) -> Sender:
        """Return a sender for a topic; `key` is its key on the bus.

        In wall-clock mode a sender drops messages for a slow reader, since a frozen recorder would block physics and planning.
        Only latched topics wait.
        """
        if Settings.read().runtime == "wallclock" and not qos.transient_local:
            qos = qos.model_copy(update={"congestion": "DROP"})
        return Publisher(self.session, key, qos, gid, self.now, self.tagger(key))

    def subscription(self, key: str, history: bool = False, decode: Callable[[bytes], object] | None = None) -> Subscription:
        """Return a subscription to a key."""
        return Subscription(self.session, key, history, decode, self.tag_check(key))

    def tagger(self, key: str) -> Tagger | None:
        """Return the tagger for the messages of a key; None if they carry no tags."""
        name, topics = parse_key(key).topic, contract().topics
        tagged = contract().tagged(name) and (self._tags or (name in topics and topics[name].open))
        return Tagger(self.key, key) if self.key is not None and tagged else None

    def tag_check(self, key: str) -> TagCheck | None:
        """Return the check of received messages of a key; None if they carry no tags."""
        tagger = self.tagger(key)
        return None if tagger is None else TagCheck(tagger, contract().topics.get(parse_key(key).topic))


def try_decode(decode: Callable[[bytes], Any], payload: bytes) -> Any | None:
    """Return the message, or None if it cannot be decoded, so that a foreign sender cannot end a service."""
    try:
        return decode(payload)
    except CodecError:
        return None
