"""Base classes of every exception that Palpate raises on purpose, and the exit status of its commands.

Imports no other package of Palpate, so every package may use it.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from enum import IntEnum


class ExitStatus(IntEnum):
    """Exit status of a command other than 0."""

    TROUBLE = 1
    """A check found something wrong, or the output could not be written."""
    BAD_INPUT = 2
    """The command refused its input and started nothing."""
    FAILED = 3
    """The command failed after it had started."""
    INTERRUPTED = 130
    """After SIGINT, as in shells and Typer."""


class PalpateError(Exception):
    """Base class. The message names what failed, the value, what is allowed and what to do."""


class UserError(PalpateError, ValueError):
    """Unusable input from a person or a file. The command prints the message as one line and exits with status 2."""


class RunError(PalpateError, RuntimeError):
    """A run or a part of it failed after it started. The command reports what was measured and exits with status 3."""


@contextmanager
def restate(
    cause: type[Exception] | tuple[type[Exception], ...],
    error: type[Exception],
    name: object,
    but: type[Exception] | tuple[type[Exception], ...] = (),
) -> Iterator[None]:
    """Raise `error` in place of a `cause` in a `with` block. Its text is `name`, then that of the cause. Those of `but` pass."""
    try:
        yield
    except but:
        raise
    except cause as problem:
        reason = problem.strerror if isinstance(problem, OSError) and problem.strerror else problem
        raise error(f"{name}: {reason}") from problem
