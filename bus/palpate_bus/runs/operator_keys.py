"""Keys to stop or release a run in the terminal that displays it.

| key | |
|---|---|
| s | soft stop: the arm retreats along the normal and waits |
| e | emergency stop: the driver holds the arm safely |
| r | release: the examination resumes |

Keys are read only if standard input is a terminal with this process in the foreground.
"""

from __future__ import annotations

import os
import sys
import termios
import tty
from contextlib import suppress
from select import select
from types import TracebackType
from typing import Any, Self

KEYS = {"s": "soft-stop", "e": "stop", "r": "release"}
"""Requests of `operator_requests` by key."""
HINT = "keys: s soft stop, e emergency stop, r release"


class OperatorKeys:
    """Context manager that reads keys without blocking, and restores the terminal."""

    def __init__(self) -> None:
        self._fd = -1
        self._before: list[Any] = []

    @property
    def attached(self) -> bool:
        """True if there is a terminal to read from."""
        return bool(self._before)

    def __enter__(self) -> Self:
        # The terminal would stop a background job that uses it.
        if sys.stdin is not None and sys.stdin.isatty() and os.tcgetpgrp(sys.stdin.fileno()) == os.getpgrp():
            self._fd = sys.stdin.fileno()
            self._before = termios.tcgetattr(self._fd)
            tty.setcbreak(self._fd)  # no echo, no line buffer; Ctrl+C still works
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if self._before:
            with suppress(termios.error):  # the terminal is gone
                termios.tcsetattr(self._fd, termios.TCSADRAIN, self._before)
            self._before = []

    def pressed(self) -> list[str]:
        """Return the requests of the keys pressed since the last call."""
        words = []
        while self._before and select([self._fd], [], [], 0)[0]:
            key = os.read(self._fd, 64)
            if not key:  # the terminal is gone
                self._before = []
            words += [KEYS[letter] for letter in key.decode("ascii", "ignore").lower() if letter in KEYS]
        return words
