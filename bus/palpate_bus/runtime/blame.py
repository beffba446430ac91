"""Where the wall time of a service goes: computing, encoding, decoding, sending, transport and waiting for others."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(slots=True)
class Blame:
    """Accumulated wall time [ns] of one service, and for which roles it waited."""

    compute: int = 0
    """Inside `step`, without decoding."""
    encode: int = 0
    decode: int = 0
    send: int = 0
    """Handing messages to the transport."""
    transport: int = 0
    """Between the sending of the message that was waited for last and its reception."""
    wait: int = 0
    """Waiting for another service to finish its step, transport excluded."""
    steps: int = 0
    waited_for: dict[str, int] = field(default_factory=dict)
    """Waiting time [ns] by the role that was waited for last."""

    def waited(self, role: str, duration: int, transport: int) -> None:
        """Counts one wait [ns] that ended with a message of `role` which was `transport` [ns] under way."""
        transport = min(max(transport, 0), duration)
        self.transport += transport
        self.wait += duration - transport
        self.waited_for[role] = self.waited_for.get(role, 0) + duration - transport

    def per_step_us(self) -> dict[str, object]:
        """Means in microseconds a step, for the report."""
        steps = max(self.steps, 1)
        figures: dict[str, object] = {
            name: round(getattr(self, name) / steps / 1e3, 2)
            for name in ("compute", "decode", "encode", "send", "transport", "wait")
        }
        figures["steps"] = self.steps
        figures["waited_for"] = {
            role: round(duration / steps / 1e3, 2)
            for role, duration in sorted(self.waited_for.items(), key=lambda item: -item[1])
        }
        return figures
