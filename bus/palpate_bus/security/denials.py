"""Whom a router turned away: read from zenoh's log, since zenoh tells nobody else.

A denied message leaves two lines at level trace: one that says who, what and where, then `Msg intercepted!` of the same thread.
Only what came in counts (`ingress`): that a subscription is not passed on to those it does not concern is no attempt. A peer that
fails the handshake leaves a warning of the TLS link.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from time import time
from typing import Any

from palpate_bus.wire.rmw import WireError, parse_key

FILTER = "error,zenoh::net::routing::interceptor=trace,zenoh_link_tls=warn"
"""What RUST_LOG has to be in the router's process."""
STRANGER = "stranger"
"""Name of a peer without a valid certificate."""
LIMIT = 1000
"""Different denials that are kept; more than that is a flood, of which the first are enough."""

_COLOUR = re.compile(rb"\x1b\[[0-9;]*m")
_NAMED = re.compile(rb"([0-9a-f]{1,32}) on [^ ]*CertCommonName\(([^)]*)\)")
_DENIED = re.compile(rb"([0-9a-f]{1,32})(?: on [^ ]+)? is unauthorized to ([A-Za-z/ ]+) \(ingress\) on (\S+)")
_STRANGER = re.compile(rb"WARN .*zenoh_link_tls[^:]*: ?(?:[a-z_:]+:)? ?(.*)")
_INTERCEPTED = b"Msg intercepted!"


@dataclass
class Denial:
    """One kind of attempt and how often it was made."""

    who: str
    """Common name of the certificate; `stranger` for a peer that did not get in."""
    action: str
    """`Put`, `Declare Subscriber`, ... as zenoh calls it; `Connect` for a stranger."""
    key: str
    """Key, or for a stranger what was wrong."""
    count: int = 1
    first: float = 0.0
    """Wall time [s]."""
    last: float = 0.0

    @property
    def topic(self) -> str:
        """The topic of the key, or the key."""
        try:
            return parse_key(self.key).topic
        except WireError:
            return self.key

    @property
    def sentence(self) -> str:
        """For a log or a table."""
        if self.who == STRANGER:
            return f"a stranger tried to connect: {self.key} ({self.count} x)"
        return f"{self.who} tried to {self.action.lower()} {self.topic}: denied ({self.count} x)"

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return asdict(self)


class DenialReader:
    """Takes a router's log in pieces and keeps the denials in it."""

    def __init__(self) -> None:
        self.denials: dict[tuple[str, str, str], Denial] = {}
        self.dropped = 0
        """Kinds of attempts beyond `LIMIT`."""
        self._rest = b""
        self._names: dict[bytes, str] = {}
        self._candidate: dict[bytes, bytes] = {}

    def feed(self, data: bytes) -> Iterator[Denial]:
        """Yields each denial that was not seen before."""
        lines = (self._rest + data).split(b"\n")
        self._rest = lines.pop()
        for raw in lines:
            if b"authorized to" in raw and b"unauthorized" not in raw and b"CertCommonName" not in raw:
                continue  # by far the most lines
            denial = self._line(_COLOUR.sub(b"", raw))
            if denial is not None:
                yield denial

    def _line(self, line: bytes) -> Denial | None:
        thread = _thread(line)
        if _INTERCEPTED in line:
            match = _DENIED.search(self._candidate.pop(thread, b""))
            if match is None:
                return None
            zid, action, key = match.groups()
            who = self._names.get(zid, zid.decode())
            return self._count(who, action.decode().split("/")[-1].strip(), key.decode(errors="replace"))
        named = _NAMED.search(line)
        if named is not None:
            self._names[named[1]] = named[2].decode(errors="replace")
        if b"access_control" in line:
            self._candidate[thread] = line
            return None
        stranger = _STRANGER.search(line)
        if stranger is not None:
            reason = stranger[1].decode(errors="replace").partition(". Hint:")[0].strip()
            return self._count(STRANGER, "Connect", reason)
        return None

    def _count(self, who: str, action: str, key: str) -> Denial | None:
        now = time()
        known = self.denials.get((who, action, key))
        if known is not None:
            known.count += 1
            known.last = now
            return None
        if len(self.denials) >= LIMIT:
            self.dropped += 1
            return None
        made = self.denials[who, action, key] = Denial(who, action, key, first=now, last=now)
        return made


def _thread(line: bytes) -> bytes:
    begin = line.find(b"ThreadId(")
    return line[begin : line.find(b")", begin)]
