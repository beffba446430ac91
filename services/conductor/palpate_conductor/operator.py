"""Operator interface: a zenoh queryable that forwards requests to `operator/request`, see `palpate_bus.runs.operator`.

It answers once the supervisor confirms or refuses the request.
"""

import json
from collections.abc import Callable
from dataclasses import dataclass
from queue import SimpleQueue
from time import monotonic, time_ns
from typing import Any

import zenoh

from palpate_bus.messages import SupervisorState
from palpate_bus.runs.operator import CONFIRM_S, TAGGED, TIME_REQUESTS, WORDS, request_key
from palpate_bus.wire.rmw import Tagger
from palpate_errors import RunError, UserError
from palpate_inputs import parse_json

REQUEST_BYTES = 4096
"""A longer request is refused."""


@dataclass
class _Pending:
    query: Any
    word: str
    since: float
    releases: int
    refusals: int


class OperatorRequestServer:
    """The conductor's side. Call `poll` often."""

    def __init__(
        self,
        session: zenoh.Session,
        domain: int,
        send: Callable[[int, str], None],
        pace: Callable[[str, int], str],
        key: bytes | None = None,
    ) -> None:
        """`send(request, reason)` publishes a request, see `palpation_msgs/OperatorRequest`. It raises UserError to refuse
        it, and RunError if the request ends the run.

        `pace(word, ms)` carries out one of `TIME_REQUESTS` and returns the answer, or raises UserError. With the
        run's `key`, the requests in `TAGGED` need a tag.
        """
        self._pace = pace
        self._key = request_key(domain)
        self._tagger = None if key is None else Tagger(key, self._key)
        self._newest = time_ns()
        self._send = send
        self._asked: SimpleQueue[Any] = SimpleQueue()
        self._pending: list[_Pending] = []
        self._queryable = session.declare_queryable(self._key, zenoh.handlers.Callback(self._asked.put, indirect=False))

    def poll(self, supervisor: Any | None) -> None:
        """Forward new requests, and answer those that the newest supervisor state confirms or refuses."""
        while not self._asked.empty():  # this is the only reader
            self._take(self._asked.get(), supervisor)
        for pending in list(self._pending):
            answer = _answer(pending, supervisor)
            if answer is not None:
                self._reply(pending.query, *answer, monotonic() - pending.since)
                self._pending.remove(pending)

    def _take(self, query: Any, supervisor: Any | None) -> None:
        try:
            payload = bytes(query.payload.to_bytes())
            asked = parse_json(payload if len(payload) <= REQUEST_BYTES else b"", self._key)
            reason = str(asked["reason"]).encode(errors="replace").decode()  # invalid bytes of a terminal must not prevent a stop
            word, ms, sent = asked["word"], int(asked.get("ms", 0)), int(asked.get("sent", 0))
            request = None if word in TIME_REQUESTS else WORDS[word]
        except (AttributeError, KeyError, OverflowError, TypeError, UserError, ValueError, zenoh.ZError):
            self._reply(query, False, f"no request: expected one of {', '.join((*WORDS, *TIME_REQUESTS))} and a reason", 0.0)
            return
        if word in TAGGED and not self._authentic(query, payload, sent):
            self._reply(query, False, f"{word} is refused: it needs the run's key (PALPATE_KEY), and a time after the last", 0.0)
            return
        if request is None:
            try:
                done, text = True, self._pace(word, ms)
            except UserError as error:
                done, text = False, str(error)
            self._reply(query, done, text, 0.0)
            return
        try:
            self._send(request, reason)
        except UserError as refused:
            self._reply(query, False, str(refused), 0.0)
            return
        except RunError as ended:
            self._reply(query, True, str(ended), 0.0)
            raise
        before = (0, 0) if supervisor is None else (int(supervisor.releases), int(supervisor.refusals))
        self._pending.append(_Pending(query, word, monotonic(), *before))

    def _authentic(self, query: Any, payload: bytes, sent: int) -> bool:
        """Return True if a request has a valid tag and is newer [ns] than the last, or if the run has no key."""
        if self._tagger is None:
            return True
        tag = b"" if query.attachment is None else bytes(query.attachment.to_bytes())
        if sent <= self._newest or not self._tagger.holds(tag, payload):
            return False
        self._newest = sent
        return True

    def _reply(self, query: Any, done: bool, text: str, after_s: float) -> None:
        query.reply(self._key, json.dumps({"done": done, "words": text, "after_ms": round(after_s * 1e3, 1)}))
        query.drop()

    def close(self) -> None:
        """Undeclare the queryable."""
        self._queryable.undeclare()  # type: ignore[no-untyped-call]


def _answer(pending: _Pending, supervisor: Any | None) -> tuple[bool, str] | None:
    """Return (True if it is done, text for the operator); None while it is neither confirmed nor refused."""
    if supervisor is not None:
        if pending.word == "stop" and supervisor.level == SupervisorState.LEVEL_EMERGENCY:
            return True, f"the driver holds: {supervisor.reason}"
        if pending.word == "soft-stop" and supervisor.level != SupervisorState.LEVEL_OK:
            return True, f"the arm retreats, then waits: {supervisor.reason}"
        releases = pending.word in ("release", "end")
        if releases and supervisor.releases > pending.releases:
            return True, "released"
        if releases and supervisor.refusals > pending.refusals:
            return False, supervisor.reason
    if monotonic() - pending.since > CONFIRM_S:
        return False, f"sent, but the supervisor did not confirm it within {CONFIRM_S:g} s"
    return None
