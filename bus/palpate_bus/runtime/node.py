"""What one service in a process of its own goes through, whatever clock drives it: join, start, step, report, leave."""

from __future__ import annotations

from abc import ABC, abstractmethod
from contextlib import suppress
from typing import Any, Final

from palpate_bus.messages import RunControl, ServiceReport
from palpate_bus.runtime.conductor_link import ConductorLink, RunAborted
from palpate_bus.runtime.failure import described
from palpate_bus.runtime.lockstep import NEVER, Stepper
from palpate_bus.runtime.member import Member
from palpate_bus.runtime.output import ServiceOutput
from palpate_bus.service import Service

POLL_S: Final = 0.05
"""How often a waiting node looks for messages of the conductor."""


class Node(ABC):
    """One service on the bus."""

    def __init__(self, service: Service, member: Member, strict: bool) -> None:
        """`strict`: whether inputs have to come without a gap, see `Stepper`."""
        self._service = service
        self._stepper = Stepper(service, member.rules, strict)
        self._now = member.transport.now
        self._link = ConductorLink(member)
        self._output = ServiceOutput(member)
        self._tick = NEVER
        """The last tick that was stepped [ns]."""

    def run(self) -> None:
        """Runs the service to the end of the run. Raises what the service raises, after reporting it, or RunAborted."""
        try:
            self._join()
            latched = self._stepper.start()
            self._output.send(latched)
            self._output.record(latched, 0)
            self._loop()
            self._output.flush(self._tick)
            facts = dict(self._service.finish())
            detail = {"blame": self._stepper.blame.per_step_us(), "facts": facts, **self._counts()}
            self._link.report(ServiceReport.FINISHED, self._tick, detail=detail)
            self._await_end()
        except RunAborted:
            self._service.finish()
            raise
        except Exception as error:
            with suppress(Exception):
                self._output.flush(self._tick)  # what others have heard belongs in the recording
            words = described(error, self._stepper.buffers.values())
            self._link.report(ServiceReport.FAILED, self._tick, detail={"error": words})
            with suppress(Exception):
                self._service.finish()  # what it has open is closed
            raise

    @abstractmethod
    def _join(self) -> None:
        """Answers the conductor's hellos until it starts the run."""

    @abstractmethod
    def _loop(self) -> None:
        """Steps the service until the run ends."""

    @abstractmethod
    def _counts(self) -> dict[str, Any]:
        """What the node has counted and computed about its messages, for the conductor."""

    def _await_end(self) -> None:
        """Waits for the conductor's receipt."""
        while True:
            message = self._link.poll(POLL_S)
            if message is not None and message.command == RunControl.END:
                return
