"""An operator's request to a run: a query that its conductor answers once the supervisor confirms it.

Asked by `palpate stop`, `release`, `pause`, `resume` and `step`, and by the keys of `palpate dashboard` and `palpate run`.
"""

from __future__ import annotations

import json

import zenoh

from palpate_bus.messages import OperatorRequest
from palpate_errors import RunError

CONFIRM_S = 2.0
"""How long a confirmation is waited for, by wall clock."""
WORDS = {
    "stop": OperatorRequest.STOP,
    "soft-stop": OperatorRequest.SOFT_STOP,
    "release": OperatorRequest.RELEASE,
    "end": OperatorRequest.END,
}
"""What can be asked of the examination, with the request it is passed on as."""
TIME_REQUESTS = ("pause", "resume", "step")
"""What can be asked of the conductor of a lockstep run: to grant no more time, to grant it again, to grant a little."""


class NotAnswered(RunError):
    """No run answered the request, or it was refused. The message says which."""


class NoConductorError(NotAnswered):
    """No conductor answered: it has not been discovered yet, has not started, or has left."""


def request_key(domain: int) -> str:
    """The key of the query."""
    return f"{domain}/palpate/operator"


def ask(session: zenoh.Session, domain: int, word: str, reason: str, ms: int = 0) -> tuple[str, float]:
    """Sends a request of `WORDS` or `TIME_REQUESTS` to the run on this bus; returns its answer, and when it was confirmed [ms].

    `ms` is for `step`: the simulated time to grant. Raises NotAnswered.
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
    """As `ask`, but returns a sentence on the result to show to the operator, also when there was no answer."""
    try:
        answer, after_ms = ask(session, domain, word, reason)
    except NotAnswered as error:
        return f"{word}: {error}"
    return f"{word}: {answer} (confirmed after {after_ms:.0f} ms)"
