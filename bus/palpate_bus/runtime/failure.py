"""Failures of runs and services: a code for programs and a text for people."""

import errno
from collections.abc import Iterable, Mapping
from contextlib import suppress
from enum import StrEnum
from traceback import walk_tb
from typing import Any, NamedTuple

from palpate_bus.contract.port_check import Checker, RefusedMessage
from palpate_bus.messages import CodecError, Message
from palpate_bus.runtime.lockstep import ForgedSenderError, InputBuffer, LockstepError, Packet
from palpate_plugins import USER_MODULE


class FailureCode(StrEnum):
    """Cause of the early end of a run."""

    INTERRUPTED = "interrupted"
    """Ctrl-C or SIGTERM ended the run."""
    STOPPED = "stopped"
    """The program that conducts the run ended it."""
    START_FAILED = "start_failed"
    """A service raised or its process exited before the first tick."""
    NO_ANSWER = "no_answer"
    """A service did not answer before the first tick, or has an input without a sender."""
    ROLE_LOST = "role_lost"
    """A process exited or its connection closed."""
    ROLE_FAILED = "role_failed"
    """A service raised."""
    FROZEN = "frozen"
    """A process is stopped, or uses no processor time."""
    BLOCKED = "blocked"
    """No service finished a tick for too long."""
    EXAM_SILENT = "exam_silent"
    """Planning publishes no state in wall-clock mode."""
    CONDUCTOR_LOST = "conductor_lost"
    TRANSPORT_LOST = "transport_lost"
    FORGED = "forged"
    """A second sender uses the identity of a service or of the conductor."""
    CONTRACT_BROKEN = "contract_broken"
    """A message was refused, or planning announced an end that has passed."""
    DISK_FULL = "disk_full"
    GAVE_UP = "gave_up"
    """Planning aborted the examination."""
    UNENDED = "unended"
    """The examination did not end before the limit of simulated time."""
    UNSAMPLED = "unsampled"
    """Targets that planning calls felt were not sampled."""
    UNFINISHED = "unfinished"
    """Recovered from a recording without an end."""
    DAMAGED = "damaged"
    """Recovered from a recording without an end, parts of which are lost."""
    INTERNAL = "internal"
    """An unexpected error in the conductor."""


class Failure(NamedTuple):
    """Failure of a run. Programs use `code`, `roles` and `topics`; `text` is for people."""

    code: FailureCode
    text: str
    roles: tuple[str, ...] = ()
    """Roles that failed or are missing."""
    topics: tuple[str, ...] = ()
    """Topics whose messages break the contract."""

    def __str__(self) -> str:
        return self.text

    def with_note(self, note: str) -> "Failure":
        """Return the same failure with `note` appended to its text."""
        return self._replace(text=f"{self.text}; {note}")

    @classmethod
    def of(cls, error: BaseException, role: str, buffers: Iterable[InputBuffer]) -> "Failure":
        """Return the failure of the service `role` that raised `error`.

        The text has the error, preceded by the last line of a user-defined file in its traceback, and each input that breaks the
        contract with the role that sends it.
        """
        if isinstance(error, RefusedMessage):
            return cls(FailureCode.CONTRACT_BROKEN, f"{_own_line(error)}{error}", (error.role,), (error.topic,))
        found: dict[str, str] = {}
        with suppress(Exception):  # an invalid input must not hide the error
            found = invalid_inputs(buffers)
        code = FailureCode.ROLE_FAILED
        if isinstance(error, ForgedSenderError):
            code = FailureCode.FORGED
        elif isinstance(error, OSError) and error.errno == errno.ENOSPC:
            code = FailureCode.DISK_FULL
        text = "; ".join((f"{_own_line(error)}{type(error).__name__}: {error}", *found.values()))
        topics = dict.fromkeys([error.topic] if isinstance(error, LockstepError) and error.topic else []) | found
        return cls(code, text, (role,), tuple(topics))

    def report(self) -> dict[str, Any]:
        """Return the detail of a ServiceReport, see `from_report`."""
        return {"error": self.text, "code": self.code.value, "roles": self.roles, "topics": self.topics}

    @classmethod
    def from_report(cls, role: str, detail: Mapping[str, Any]) -> "Failure":
        """Return the failure that the service `role` reported."""
        code = detail.get("code")
        known = FailureCode(str(code)) if code in {*FailureCode} else FailureCode.ROLE_FAILED
        roles, topics = tuple(map(str, detail.get("roles", (role,)))), tuple(map(str, detail.get("topics", ())))
        return cls(known, str(detail.get("error", "unknown error")), roles, topics)


def _own_line(error: BaseException) -> str:
    frames = [(frame, line) for frame, line in walk_tb(error.__traceback__)]
    own = [(f.f_code.co_filename, line) for f, line in frames if str(f.f_globals.get("__name__", "")).startswith(USER_MODULE)]
    return f"{own[-1][0]}, line {own[-1][1]}: " if own else ""


def invalid_inputs(buffers: Iterable[InputBuffer]) -> dict[str, str]:
    """Return a sentence for each topic whose newest messages cannot be decoded or have values outside the contract."""
    found = {}
    for buffer in buffers:
        for received in buffer.new or ([buffer.latest] if buffer.latest is not None else []):
            if fault := _fault(buffer, received):
                found[buffer.topic.name] = f"{buffer.topic.name} from {buffer.topic.producer} {fault}"
                break
    return found


def _fault(buffer: InputBuffer, received: Packet) -> str:
    try:
        message: Message = received.message or buffer.decode(received.payload)
    except CodecError:
        return f"cannot be decoded ({len(received.payload)} bytes)"
    faults = Checker(buffer.topic)(message)
    return f"has {faults[0].field} {faults[0].got}; the contract requires {faults[0].expected}" if faults else ""
