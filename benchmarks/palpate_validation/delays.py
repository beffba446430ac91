"""Message delay and jitter around any service: what it is sent reaches it later, in order.

    control = Delayed(create_control(scenario), {"joint_states": BusDelay(0.004, 0.002, seed=1)})

The wrapper sits between a service and its inbox, so it works in every runtime, and the service does not know.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np

from palpate_bus.messages.codec import Message
from palpate_bus.messages.stamps import NS
from palpate_bus.service import Inbox, Outbox, Service

Observe = Callable[[int, Mapping[str, Any]], None]
"""Called with the time [ns] and the outbox of each step."""
Script = Callable[[int], Mapping[str, Message]]
"""Messages that a topic without a producer is to bring at a time [ns]."""


class BusDelay:
    """How long messages of one topic are under way: `delay_s`, and up to `jitter_s` more, uniform. They stay in order."""

    def __init__(self, delay_s: float, jitter_s: float = 0.0, seed: int = 0) -> None:
        if delay_s < 0 or jitter_s < 0:
            raise ValueError(f"bus delay {delay_s} s with jitter {jitter_s} s: must not be negative")
        self._delay = round(delay_s * NS)
        self._jitter = round(jitter_s * NS)
        self._rng = np.random.Generator(np.random.PCG64(seed))
        self._last = 0

    def arrival(self, t: int) -> int:
        """When a message sent at `t` [ns] arrives [ns]; never before the one sent before it."""
        late = int(self._rng.integers(self._jitter + 1)) if self._jitter else 0
        self._last = max(self._last, t + self._delay + late)
        return self._last


class DelayedInbox:
    """An inbox some of whose topics bring their messages later, and some of which are scripted."""

    def __init__(self, delays: Mapping[str, BusDelay]) -> None:
        self._delays = delays
        self._under_way: dict[str, deque[tuple[int, int | None, Message]]] = {topic: deque() for topic in delays}
        self._new: dict[str, list[Message]] = {}
        self._latest: dict[str, tuple[int | None, Message]] = {}
        self._inbox: Inbox | None = None

    def advance(self, t: int, inbox: Inbox, scripted: Mapping[str, Message]) -> None:
        """Takes what has been sent and hands on what has arrived by `t` [ns]."""
        self._inbox = inbox
        self._new = {topic: [message] for topic, message in scripted.items()}
        for topic, message in scripted.items():
            self._latest[topic] = (t, message)
        for topic, delay in self._delays.items():
            waiting = self._under_way[topic]
            for message in inbox.new(topic):
                waiting.append((delay.arrival(t), inbox.stamp(topic), message))
            arrived = self._new[topic] = []
            while waiting and waiting[0][0] <= t:
                _, stamp, message = waiting.popleft()
                arrived.append(message)
                self._latest[topic] = (stamp, message)

    def _mine(self, topic: str) -> bool:
        return topic in self._delays or topic in self._latest

    @property
    def _real(self) -> Inbox:
        if self._inbox is None:
            raise RuntimeError("a delayed inbox is read before its first step")
        return self._inbox

    def latest(self, topic: str) -> Message | None:
        """The newest message that has arrived."""
        if self._mine(topic):
            return self._latest[topic][1] if topic in self._latest else None
        return self._real.latest(topic)

    def new(self, topic: str) -> Iterable[Message]:
        """What arrived since the step before."""
        return self._new.get(topic, []) if self._mine(topic) else self._real.new(topic)

    def stamp(self, topic: str) -> int | None:
        """When the newest message that has arrived was sent [ns]."""
        if self._mine(topic):
            return self._latest[topic][0] if topic in self._latest else None
        return self._real.stamp(topic)

    def lost(self, role: str) -> bool:
        """Whether that role's service is gone."""
        return self._real.lost(role)


class Delayed(Service):
    """A service whose messages come late. Its role is the inner service's."""

    def __init__(
        self, inner: Service, delays: Mapping[str, BusDelay], observe: Observe | None = None, script: Script | None = None
    ) -> None:
        self.role = inner.role  # type: ignore[misc]  # of the instance: one wrapper for every role
        self._inner = inner
        self._inbox = DelayedInbox(delays)
        self._observe = observe
        self._script = script

    def start(self) -> Outbox:
        """The inner service's latched messages."""
        return self._inner.start()

    def step(self, t: int, inbox: Inbox) -> Outbox:
        """A step of the inner service on what has arrived."""
        self._inbox.advance(t, inbox, self._script(t) if self._script else {})
        outbox = self._inner.step(t, self._inbox)
        if self._observe:
            self._observe(t, outbox)
        return outbox

    def finish(self) -> Mapping[str, Any]:
        """The inner service's facts."""
        return self._inner.finish()
