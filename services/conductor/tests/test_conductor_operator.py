"""What an operator is told of his word."""

from __future__ import annotations

import json
from types import SimpleNamespace
from typing import Any

from palpate_bus.messages import SupervisorState
from palpate_bus.messages.stamps import header
from palpate_conductor.operator import OperatorRequestServer


class Query:
    """Somebody asks."""

    def __init__(self, word: str, ms: int = 0) -> None:
        text = json.dumps({"word": word, "reason": "test", "ms": ms})
        self.payload = SimpleNamespace(to_bytes=text.encode)
        self.answer: dict[str, Any] | None = None

    def reply(self, key: str, text: str) -> None:
        self.answer = json.loads(text)

    def drop(self) -> None:
        """As zenoh's."""


class Session:
    """Takes the server's queryable."""

    def declare_queryable(self, key: str, handler: Any) -> Any:
        return SimpleNamespace(undeclare=lambda: None)


def state(level: int, reason: str, releases: int = 0, refusals: int = 0) -> Any:
    return SupervisorState(header(0), level, 1, reason, releases, 0.0, -1.0, 0.0, refusals)


def never(word: str, ms: int) -> str:
    raise ValueError("time is the wall's")


def asked(word: str, before: Any, after: Any) -> tuple[bool, str]:
    sent: list[int] = []
    server = OperatorRequestServer(Session(), 0, lambda request, reason: sent.append(request), never)  # type: ignore[arg-type]
    query = Query(word)
    server._asked.put(query)
    server.attend(before)
    assert sent
    assert query.answer is None, "nothing is confirmed by what was there before"
    server.attend(after)
    assert query.answer is not None
    return query.answer["done"], query.answer["words"]


def test_a_second_release_is_not_answered_with_the_first_ones_refusal() -> None:
    refused = state(2, "release refused: 45 N", refusals=1)
    assert asked("release", refused, state(0, "", releases=1, refusals=1)) == (True, "released")


def test_a_refusal_says_why() -> None:
    assert asked("release", state(2, "45 N"), state(2, "release refused: 45 N", refusals=1)) == (False, "release refused: 45 N")


def test_words_about_time_are_answered_by_the_conductor_itself() -> None:
    for pace, answer in ((lambda word, ms: f"{word} {ms}", (True, "step 3")), (never, (False, "time is the wall's"))):
        server = OperatorRequestServer(Session(), 0, lambda request, reason: None, pace)  # type: ignore[arg-type]
        query = Query("step", 3)
        server._asked.put(query)
        server.attend(None)
        assert query.answer is not None
        assert (query.answer["done"], query.answer["words"]) == answer
