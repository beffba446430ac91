"""Where an operator's word reaches a run: a queryable of the conductor, asked by `palpate stop` and `palpate release`.

The conductor passes the word on as `operator/request` and answers once the supervisor confirms it, so that the operator knows.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from queue import Empty, SimpleQueue
from time import monotonic
from typing import Any

import zenoh
from palpate_bus.messages import OperatorRequest, SupervisorState

CONFIRM_S = 2.0
"""How long a confirmation is waited for, by wall clock."""
WORDS = {"stop": OperatorRequest.STOP, "release": OperatorRequest.RELEASE, "end": OperatorRequest.END}


def desk_key(domain: int) -> str:
    """The key on which a run is asked."""
    return f"{domain}/palpate/operator"


@dataclass
class _Pending:
    query: Any
    word: str
    since: float
    releases: int


class OperatorDesk:
    """The conductor's side. `attend` it often."""

    def __init__(self, session: zenoh.Session, domain: int, send: Callable[[int, str], None]) -> None:
        """`send(request, reason)` passes a request on, see `palpation_msgs/OperatorRequest`."""
        self._key = desk_key(domain)
        self._send = send
        self._asked: SimpleQueue[Any] = SimpleQueue()
        self._pending: list[_Pending] = []
        self._queryable = session.declare_queryable(self._key, zenoh.handlers.Callback(self._asked.put, indirect=False))

    def attend(self, supervisor: Any | None) -> None:
        """Passes on what was asked, and answers what the supervisor's newest state confirms or refuses."""
        while True:
            try:
                query = self._asked.get_nowait()
            except Empty:
                break
            self._take(query, 0 if supervisor is None else int(supervisor.releases))
        for pending in list(self._pending):
            answer = _answer(pending, supervisor)
            if answer is not None:
                self._reply(pending.query, *answer, monotonic() - pending.since)
                self._pending.remove(pending)

    def _take(self, query: Any, releases: int) -> None:
        try:
            asked = json.loads(query.payload.to_bytes())
            word, reason = asked["word"], str(asked["reason"])
            request = WORDS[word]
        except (AttributeError, KeyError, TypeError, ValueError):
            self._reply(query, False, f"no request: want a word out of {', '.join(WORDS)} and a reason", 0.0)
            return
        self._send(request, reason)
        self._pending.append(_Pending(query, word, monotonic(), releases))

    def _reply(self, query: Any, done: bool, words: str, after_s: float) -> None:
        query.reply(self._key, json.dumps({"done": done, "words": words, "after_ms": round(after_s * 1e3, 1)}))
        query.drop()

    def close(self) -> None:
        """Answers nobody any more."""
        self._queryable.undeclare()  # type: ignore[no-untyped-call]


def _answer(pending: _Pending, supervisor: Any | None) -> tuple[bool, str] | None:
    """(Whether it is done, in words), None while nothing is known."""
    if supervisor is not None:
        if pending.word == "stop" and supervisor.level == SupervisorState.LEVEL_EMERGENCY:
            return True, f"the driver holds: {supervisor.reason}"
        if pending.word != "stop" and supervisor.releases > pending.releases:
            return True, "released"
        if pending.word != "stop" and supervisor.reason.startswith("release refused"):
            return False, supervisor.reason
    if monotonic() - pending.since > CONFIRM_S:
        return False, f"passed on, but the supervisor did not confirm it within {CONFIRM_S:g} s"
    return None


class NotAnswered(RuntimeError):
    """No run took the word, or it was refused. The message says which."""


def ask(session: zenoh.Session, domain: int, word: str, reason: str) -> tuple[str, float]:
    """Says a word of `WORDS` to the run on this bus; returns its answer and how long the confirmation took [ms].

    Raises NotAnswered.
    """
    payload = json.dumps({"word": word, "reason": reason})
    for reply in session.get(desk_key(domain), payload=payload, timeout=2 * CONFIRM_S):
        if reply.ok is None:
            continue
        answer = json.loads(reply.ok.payload.to_bytes())
        if not answer["done"]:
            raise NotAnswered(answer["words"])
        return answer["words"], float(answer["after_ms"])
    raise NotAnswered("the run does not answer: its conductor is gone, or has not started it yet")
