"""zenoh publishers and subscriptions with rmw_zenoh's attachment, garbage counted and set aside.

No callback computes: a received sample goes into a queue of its own, which the service's thread empties.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import count
from queue import Empty, SimpleQueue
from time import monotonic, time_ns
from typing import Any, NamedTuple, Protocol

import zenoh

from palpate_bus.contract import Qos, contract
from palpate_bus.messages.codec import CodecError
from palpate_bus.settings import Settings
from palpate_bus.wire.rmw import AttachmentWriter, WireError, hello_key, parse_key, unpack
from palpate_bus.wire.tags import Tagger, read_key

HELLO = 0
"""Sequence number of the empty message that tests an edge before the first tick; data starts at 1."""


class ReceivedSample(NamedTuple):
    """What came in on a subscription."""

    sequence: int
    sent: int
    """Wall time [ns] at which the sender handed it over."""
    payload: bytes


class Sender(Protocol):
    """The sending end of a topic."""

    def put(self, payload: bytes, sequence: int) -> None:
        """Sends a message."""

    def hello(self) -> None:
        """Sends the empty message that tests the edge."""

    def close(self) -> None:
        """Undeclares it."""


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
        """`now` gives the wall time [ns] that each message carries; with a `tagger` it carries a tag, too."""
        self.key = key
        self._session = session
        self._now = now
        options: dict[str, Any] = {
            "priority": getattr(zenoh.Priority, qos.priority),
            "congestion_control": getattr(zenoh.CongestionControl, qos.congestion),
            "express": qos.express,
            "reliability": getattr(zenoh.Reliability, qos.reliability),
        }
        if qos.transient_local:
            self._publisher: Any = zenoh.ext.declare_advanced_publisher(
                session, key, cache=zenoh.ext.CacheConfig(qos.depth), publisher_detection=True, **options
            )
        else:
            self._publisher = session.declare_publisher(key, **options)
        self._pack = AttachmentWriter(gid).pack
        self._tagger = tagger

    def put(self, payload: bytes, sequence: int) -> None:
        """Sends a message."""
        self._publisher.put(payload, attachment=self._attachment(sequence, payload))

    def hello(self) -> None:
        """Sends the empty message that tests the edge."""
        self._session.put(hello_key(self.key), b"", attachment=self._attachment(HELLO, b""))

    def _attachment(self, sequence: int, payload: bytes) -> bytes:
        attachment = self._pack(sequence, self._now())
        return attachment if self._tagger is None else attachment + self._tagger.tag(attachment, payload)

    def close(self) -> None:
        """Undeclares the publisher."""
        self._publisher.undeclare()


class Subscription:
    """Receives on one key.

    Only the messages of the sender that says hello first count, and before any has, those of the first. Bytes without a valid
    attachment are counted in `garbage`, those of another sender in `foreign`, and where messages carry tags, those without the
    right one in `forged`. A topic that is open to all takes every sender's messages, if they can be decoded.
    """

    def __init__(
        self,
        session: zenoh.Session,
        key: str,
        history: bool = False,
        decode: Callable[[bytes], object] | None = None,
        tagger: Tagger | None = None,
    ) -> None:
        """Subscribes.

        With `history`, what a latched topic sent before is delivered too; `decode` opens the topic to all; with a `tagger` only
        tagged messages count.
        """
        self.key = key
        self._decode = decode
        self.garbage = 0
        self.foreign = 0
        self.forged = 0
        self._tagger = tagger
        self.heard = False
        self.replaced = False
        """Whether a hello has told that what came before was another's; who reads sets it back."""
        self._gid: bytes | None = None
        self._retired: bytes | None = None
        self._queue: SimpleQueue[zenoh.Sample] = SimpleQueue()
        handler = zenoh.handlers.Callback(self._queue.put, indirect=False)
        if history:
            self._subscriber: Any = zenoh.ext.declare_advanced_subscriber(
                session, key, handler, history=zenoh.ext.HistoryConfig(detect_late_publishers=True)
            )
        else:
            self._subscriber = session.declare_subscriber(key, handler)
        # Declared after the data's: a producer whose hello arrives here knows of both.
        self._hellos: Any = session.declare_subscriber(hello_key(key), handler)

    def get(self, timeout: float | None) -> ReceivedSample | None:
        """The next message; None when `timeout` [s] passes without one. A timeout of 0 does not wait."""
        end = monotonic() + timeout if timeout else 0.0
        while True:
            left = end - monotonic() if timeout else 0.0  # what is set aside wins no time
            if left <= 0 and self._queue.empty():  # nobody else takes from it; far cheaper than the exception
                return None
            try:
                raw = self._queue.get(timeout=left) if left > 0 else self._queue.get_nowait()
            except Empty:
                return None
            sample = self._taken(raw)
            if sample is not None:
                return sample

    def _taken(self, raw: zenoh.Sample) -> ReceivedSample | None:
        """What came in, or None for what is set aside."""
        try:
            attachment: bytes = raw.attachment.to_bytes()  # type: ignore[union-attr]  # none is an AttributeError
            sequence, sent, gid = unpack(attachment)
        except (WireError, AttributeError):
            self.garbage += 1
            return None
        payload = raw.payload.to_bytes()
        if self._tagger is not None and not self._tagger.holds(attachment, payload):
            self.forged += 1
            return None
        if gid != self._gid:
            greets = sequence == HELLO and not payload and not self.heard  # only a sender of this run says hello
            if self._decode is None and (gid == self._retired or (self._gid is not None and not greets)):
                self.foreign += 1
                return None
            self.replaced = self._gid is not None and self._decode is None
            self._gid = gid
        if not payload:
            self.heard = self.heard or sequence == HELLO
            return None
        # Some clients of rmw_zenoh's wire number their messages from 0.
        if sequence == HELLO if self._decode is None else decoded(self._decode, payload) is None:
            self.garbage += 1
            return None
        return ReceivedSample(sequence, sent, payload)

    @property
    def suspicion(self) -> str:
        """What is wrong with who sends here, empty while nothing is."""
        if self.forged:
            return "messages with a wrong tag come and are set aside: somebody forges them, or does not have the run's key"
        if self.foreign and self._retired is None:
            return "messages of a second sender come and are set aside"
        return ""

    def hand_over(self) -> None:
        """Forgets the sender: the next one that is another counts from now on, and nothing that still comes from this one."""
        if self._gid is not None:
            self._retired, self._gid = self._gid, None

    def close(self) -> None:
        """Undeclares the subscribers."""
        self._hellos.undeclare()
        self._subscriber.undeclare()


class Transport:
    """The members' way onto the bus by one session: their publishers, their subscriptions and their wall clock.

    The runtimes are given theirs, so that a test can hand them one that loses, changes or delays messages.
    """

    def __init__(self, session: zenoh.Session) -> None:
        self.session = session
        self._key = read_key(Settings.read().key)
        self.ids = count()
        """Numbers of the entities that members declare."""

    def now(self) -> int:
        """The wall time [ns]."""
        return time_ns()

    def publisher(self, topic: str, key: str, qos: Qos, gid: bytes) -> Sender:
        """The sending end of a topic; `key` is its key on the bus.

        By the wall clock no sender waits for a reader that does not keep up: a frozen recorder would stop physics and planning.
        Only what is sent once waits.
        """
        if Settings.read().runtime == "wallclock" and not qos.transient_local:
            qos = qos.model_copy(update={"congestion": "DROP"})
        return Publisher(self.session, key, qos, gid, self.now, self.tagger(key))

    def subscription(self, key: str, history: bool = False, decode: Callable[[bytes], object] | None = None) -> Subscription:
        """The receiving end of a key, see `Subscription`."""
        return Subscription(self.session, key, history, decode, self.tagger(key))

    def tagger(self, key: str) -> Tagger | None:
        """What tags and checks the messages of a key; None where they carry no tags."""
        wanted = self._key is not None and contract().tagged(parse_key(key).topic)
        return Tagger(self._key, key) if self._key is not None and wanted else None


def decoded(decode: Callable[[bytes], Any], payload: bytes) -> Any | None:
    """The message, or None where the bytes are none: used where anyone may send, so that no stranger can end a service."""
    try:
        return decode(payload)
    except CodecError:
        return None
