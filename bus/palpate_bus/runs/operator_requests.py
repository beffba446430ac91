"""Operator requests to a run: queries that its conductor answers after confirmation by the supervisor.

Sent by `palpate stop`, `release`, `pause`, `resume` and `step`, and by the keys of `palpate dashboard` and `palpate run`.
"""

from __future__ import annotations

import json

import zenoh

from palpate_bus.messages import OperatorRequest
from palpate_errors import RunError

CONFIRM_S = 2.0
"""Timeout of a confirmation, wall time."""
WORDS = {
    "stop": OperatorRequest.STOP,
    "soft-stop": OperatorRequest.SOFT_STOP,
    "release": OperatorRequest.RELEASE,
    "end": OperatorRequest.END,
}
"""Requests to the examination and the message constant of each."""
TIME_REQUESTS = ("pause", "resume", "step")
"""Requests to the conductor of a lockstep run: stop, continue, or briefly continue granting time."""


class NotAnswered(RunError):
    """No run answered the request, or the run refused it."""


class NoConductorError(NotAnswered):
    """No conductor answered: it has not been discovered yet, has not started, or has left."""


def request_key(domain: int) -> str:
    """Return the key of the query."""
    return f"{domain}/palpate/operator"


def ask(session: zenoh.Session, domain: int, word: str, reason: str, ms: int = 0) -> tuple[str, float]:
    """Send a request of `WORDS` or `TIME_REQUESTS` to the run on this bus; return its answer and confirmation time [ms].

    `ms`: simulated time to grant, for `step`. Raises NotAnswered.
    """
    payload = json.dumps({"word": word, "reason": reason, "ms": ms})
    for reply in session.get(request_key(domain), payload=payload, timeout=2 * CONFIRM_S):
        if reply.ok is None:
            continue
        answer = json.loads(reply.ok.payload.to_bytes())
        if not answer["done"]:
            raise NotAnswered(answer["words"])
        return answer["words"], float(answer["after_ms"])
    raise NoConductorError("the run does not answer: its conductor has left, or has not started it yet")


def order(session: zenoh.Session, domain: int, word: str, reason: str) -> str:
    """Send a request as `ask` does; return text for the operator, also without an answer."""
    try:
        answer, after_ms = ask(session, domain, word, reason)
    except NotAnswered as error:
        return f"{word}: {error}"
    return f"{word}: {answer} (confirmed after {after_ms:.0f} ms)"
