"""Life of the services of a process in any runtime: join, start, step, report, leave."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from contextlib import suppress
from time import perf_counter_ns
from typing import Any

from palpate_bus.messages import RunControl, ServiceReport
from palpate_bus.runtime.conductor_link import TIMES, ConductorLink, Reports, RunAborted
from palpate_bus.runtime.failure import Failure
from palpate_bus.runtime.lockstep import NEVER, Outgoing, Stepper
from palpate_bus.runtime.member import Member, ServiceOutput


class Seat:
    """A service in a node, with its stepper, output, reports and progress."""

    def __init__(self, stepper: Stepper, member: Member) -> None:
        self.stepper = stepper
        self.service = stepper.service
        self.role = stepper.role.name
        self.output = ServiceOutput(member)
        self.reports = Reports(member)
        self.tick = NEVER
        """Last finished tick [ns]."""
        self._closed = False

    def progress(self, waiting_for: str = "") -> None:
        """Report progress if the last report is old enough."""
        self.reports.progress(self.tick, waiting_for)

    def finish(self, counts: Mapping[str, Any]) -> None:
        """Close the service and report its end with the counts of the node."""
        self.output.flush(self.tick)
        facts = dict(self.close())
        detail = {"blame": self.stepper.blame.per_step_us(), "facts": facts, **counts}
        self.reports.send(ServiceReport.FINISHED, self.tick, detail=detail)

    def fail(self, failure: Failure) -> None:
        """Report a failure and close the service; further errors are suppressed."""
        with suppress(Exception):
            self.output.flush(self.tick)  # the recording needs every message that was sent
        self.reports.send(ServiceReport.FAILED, self.tick, detail=failure.report())
        with suppress(Exception):
            self.close()

    def close(self) -> Mapping[str, Any]:
        """Finish the service, once; return its facts."""
        if self._closed:
            return {}
        self._closed = True
        return self.service.finish()


class Node(ABC):
    """The services of a process on the bus."""

    def __init__(self, seats: Sequence[Seat], member: Member, grace_s: float = 0.0) -> None:
        """`member` receives the control messages for all; without the conductor the node continues for `grace_s` [s]."""
        self._seats = tuple(seats)
        self._link = ConductorLink(member, grace_s)
        self._acting = self._seats[0]
        """The service that is stepped or finished now."""

    def run(self) -> None:
        """Run the services to the end of the run, and close each in any case.

        Raises an error of a service after reporting it, RunAborted, or KeyboardInterrupt on SIGTERM.
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
            while (message := self._link.poll(TIMES.poll_s)) is None or message.command != RunControl.END:
                pass
        except (RunAborted, KeyboardInterrupt):
            for seat in self._seats:
                with suppress(Exception):
                    seat.output.flush(seat.tick)  # the recording needs every message that was sent
                if self._link.lost:
                    seat.reports.report_conductor_lost(seat.tick, self._link.lost)
                elif self._link.ended_by:
                    seat.reports.report_abort(seat.tick, self._link.ended_by)
                with suppress(Exception):
                    seat.close()
            raise
        except (Exception, SystemExit) as error:
            culprit = self._acting
            failure = Failure.of(error, culprit.role, culprit.stepper.buffers.values())
            if len(self._seats) > 1:
                failure = failure._replace(text=f"{culprit.role}: {failure.text}")
            for seat in self._seats:
                seat.fail(failure)
            raise

    def _step_and_send(self, seat: Seat, t: int) -> list[Outgoing]:
        """Step a service at `t` [ns]; send the messages of each part before the next is computed. Return all."""
        everything: list[Outgoing] = []
        for sent in seat.stepper.parts(t):
            start = perf_counter_ns()
            self._send(seat, sent)
            seat.stepper.blame.send += perf_counter_ns() - start
            everything += sent
        return everything

    @abstractmethod
    def _join(self) -> None:
        """Answer the conductor's hellos until it starts the run."""

    @abstractmethod
    def _loop(self) -> None:
        """Step the services until the run ends."""

    @abstractmethod
    def _send(self, seat: Seat, sent: Sequence[Outgoing]) -> None:
        """Send messages of a service."""

    @abstractmethod
    def _counts(self, seat: Seat) -> dict[str, Any]:
        """Return counts and digests of a service's messages, for the conductor."""
