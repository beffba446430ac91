"""What the services of a process go through, whatever clock drives them: join, start, step, report, leave."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any

from palpate_bus.messages import RunControl, ServiceReport
from palpate_bus.runtime.conductor_link import POLL_S, ConductorLink, Reports, RunAborted
from palpate_bus.runtime.failure import described
from palpate_bus.runtime.lockstep import NEVER, Sent, Stepper
from palpate_bus.runtime.member import Member
from palpate_bus.runtime.output import ServiceOutput


class Seat:
    """A service's place in a node: what steps it, what it sends and reports by, and how far it is."""

    def __init__(self, stepper: Stepper, member: Member) -> None:
        self.stepper = stepper
        self.service = stepper.service
        self.role = stepper.role.name
        self.output = ServiceOutput(member)
        self.reports = Reports(member)
        self.tick = NEVER
        """The last tick that was stepped [ns]."""
        self._closed = False

    def progress(self, waiting_for: str = "") -> None:
        """Reports progress if the last report is old enough."""
        self.reports.progress(self.tick, waiting_for)

    def finish(self, counts: Mapping[str, Any]) -> None:
        """Closes the service and reports its end; `counts` is what the node has counted for it."""
        self.output.flush(self.tick)
        facts = dict(self.close())
        detail = {"blame": self.stepper.blame.per_step_us(), "facts": facts, **counts}
        self.reports.say(ServiceReport.FINISHED, self.tick, detail=detail)

    def fail(self, why: str) -> None:
        """Reports a failure and closes the service, whatever else goes wrong."""
        with suppress(Exception):
            self.output.flush(self.tick)  # what others have heard belongs in the recording
        self.reports.say(ServiceReport.FAILED, self.tick, detail={"error": why})
        with suppress(Exception):
            self.close()

    def close(self) -> Mapping[str, Any]:
        """Has the service close what it has open, once; returns its facts."""
        if self._closed:
            return {}
        self._closed = True
        return self.service.finish()


class Node(ABC):
    """The services of a process on the bus."""

    def __init__(self, seats: Sequence[Seat], member: Member, grace_s: float = 0.0) -> None:
        """`member` hears the conductor for all of them; without it the node goes on for `grace_s` [s]."""
        self._seats = tuple(seats)
        self._link = ConductorLink(member, grace_s)
        self._acting = self._seats[0]
        """Whose turn it is."""

    def run(self) -> None:
        """Runs the services to the end of the run, and closes each in any case.

        Raises what a service raises, after reporting it, RunAborted, or KeyboardInterrupt when asked to leave.
        """
        try:
            self._join()
            for seat in self._seats:
                self._acting = seat
                latched = seat.stepper.start()
                self._send(seat, latched)
                seat.output.record(latched, 0)
            self._loop()
            for seat in self._seats:
                self._acting = seat
                seat.finish(self._counts(seat))
            self._await_end()
        except (RunAborted, KeyboardInterrupt):
            for seat in self._seats:
                with suppress(Exception):
                    seat.output.flush(seat.tick)  # what others have heard belongs in the recording
                if self._link.lost:
                    seat.reports.miss_conductor(seat.tick, self._link.lost)
                elif self._link.told:
                    seat.reports.obey(seat.tick, self._link.told)
                with suppress(Exception):
                    seat.close()
            raise
        except Exception as error:
            culprit = self._acting
            why = described(error, culprit.stepper.buffers.values())
            for seat in self._seats:
                seat.fail(why if len(self._seats) == 1 else f"{culprit.role}: {why}")
            raise

    @abstractmethod
    def _join(self) -> None:
        """Answers the conductor's hellos until it starts the run."""

    @abstractmethod
    def _loop(self) -> None:
        """Steps the services until the run ends."""

    @abstractmethod
    def _send(self, seat: Seat, sent: Sequence[Sent]) -> None:
        """Sends what a service gave out."""

    @abstractmethod
    def _counts(self, seat: Seat) -> dict[str, Any]:
        """What the node has counted and computed about a service's messages, for the conductor."""

    def _await_end(self) -> None:
        """Waits for the conductor's receipt."""
        while True:
            message = self._link.poll(POLL_S)
            if message is not None and message.command == RunControl.END:
                return
