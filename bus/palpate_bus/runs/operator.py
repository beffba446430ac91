"""Operator requests to a run: queries that its conductor answers after confirmation by the supervisor.

Sent by `palpate stop`, `release`, `pause`, `resume` and `step`, and by keys in the terminal of `palpate dashboard` and
`palpate run` (`OperatorKeys`): s for a soft stop (the arm retreats along the normal and waits), e for an emergency stop
(the driver holds the arm safely), r for a release (the examination resumes).
"""

import json
import os
import sys
import termios
import tty
from contextlib import suppress
from select import select
from time import time_ns
from types import TracebackType
from typing import Any, Self

import zenoh

from palpate_bus.messages import OperatorRequest
from palpate_bus.wire.rmw import Tagger
from palpate_errors import RunError

CONFIRM_S = 2.0
"""Timeout of a confirmation, wall time."""
WORDS = {word: getattr(OperatorRequest, word.replace("-", "_").upper()) for word in ("stop", "soft-stop", "release", "end")}
"""Requests to the examination and the message constant of each."""
TIME_REQUESTS = ("pause", "resume", "step")
"""Requests to the conductor of a lockstep run: stop, continue, or briefly continue granting time."""
TAGGED = frozenset(("release", "end", "resume", "step"))
"""Requests after which the arm may move: in runs with a key they need a tag. Anyone may stop or pause."""


class NotAnswered(RunError):
    """No run answered the request, or the run refused it."""


class NoConductorError(NotAnswered):
    """No conductor answered: it has not been discovered yet, has not started, or has left."""


def request_key(domain: int) -> str:
    """Return the key of the query."""
    return f"{domain}/palpate/operator"


def ask(session: zenoh.Session, domain: int, word: str, reason: str, ms: int = 0, key: bytes | None = None) -> tuple[str, float]:
    """Send a request of `WORDS` or `TIME_REQUESTS` to the run on this bus; return its answer and confirmation time [ms].

    `ms`: simulated time to grant, for `step`; `key`: the run's key. Raises NotAnswered.
    """
    where = request_key(domain)
    payload = json.dumps({"word": word, "reason": reason, "ms": ms, "sent": time_ns()}).encode()
    tag = b"" if key is None else Tagger(key, where).tag(b"", payload)
    missing: NotAnswered = NoConductorError("the run does not answer: its conductor has left, or has not started it yet")
    for reply in session.get(where, payload=payload, attachment=tag, timeout=2 * CONFIRM_S):
        if reply.ok is None:
            missing = NotAnswered("the run does not answer: its conductor is still starting, or stands still")
            continue
        answer = json.loads(reply.ok.payload.to_bytes())
        if not answer["done"]:
            raise NotAnswered(answer["words"])
        return answer["words"], float(answer["after_ms"])
    raise missing


def order(session: zenoh.Session, domain: int, word: str, reason: str, key: bytes | None) -> str:
    """Send a request as `ask` does; return text for the operator, also without an answer."""
    try:
        answer, after_ms = ask(session, domain, word, reason, key=key)
        return f"{word}: {answer} (confirmed after {after_ms:.0f} ms)"
    except NotAnswered as error:
        return f"{word}: {error}"


KEYS = {"s": "soft-stop", "e": "stop", "r": "release"}
"""Requests by key."""
HINT = "keys: s soft stop, e emergency stop, r release"


class OperatorKeys:
    """Context manager that reads keys without blocking, and restores the terminal.

    Keys are read only if standard input is a terminal with this process in the foreground.
    """

    def __init__(self) -> None:
        self._fd = -1
        self._before: list[Any] = []

    @property
    def attached(self) -> bool:
        """True if there is a terminal to read from."""
        return bool(self._before)

    def __enter__(self) -> Self:
        # The terminal would stop a background job that uses it.
        if sys.stdin is not None and sys.stdin.isatty() and os.tcgetpgrp(sys.stdin.fileno()) == os.getpgrp():
            self._fd = sys.stdin.fileno()
            self._before = termios.tcgetattr(self._fd)
            tty.setcbreak(self._fd)  # no echo, no line buffer; Ctrl+C still works
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if self._before:
            with suppress(termios.error):  # the terminal is gone
                termios.tcsetattr(self._fd, termios.TCSADRAIN, self._before)
            self._before = []

    def read_requests(self) -> list[str]:
        """Return the requests of the keys pressed since the last call."""
        words = []
        while self._before and select([self._fd], [], [], 0)[0]:
            key = os.read(self._fd, 64)
            if not key:  # the terminal is gone
                self._before = []
            words += [KEYS[letter] for letter in key.decode("ascii", "ignore").lower() if letter in KEYS]
        return words
