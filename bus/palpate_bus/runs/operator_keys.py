"""Single keys by which an operator stops or releases a run, in the terminal that shows it.

| key | |
|---|---|
| s | soft stop: the arm retreats along the normal and waits |
| e | emergency stop: the driver holds the arm safely |
| r | release: the examination goes on where it was |

Keys are read only if standard input is a terminal and this process is in its foreground.
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
"""Words of `operator_requests` by key."""
HINT = "keys: s soft stop, e emergency stop, r release"


class OperatorKeys:
    """Reads keys without waiting for them, inside a `with`; the terminal is left as it was found."""

    def __init__(self) -> None:
        self._fd = -1
        self._before: list[Any] = []

    @property
    def attached(self) -> bool:
        """Whether there is a terminal to read from."""
        return bool(self._before)

    def __enter__(self) -> Self:
        # A job in the background that touched its terminal would be stopped by it.
        if sys.stdin is not None and sys.stdin.isatty() and os.tcgetpgrp(sys.stdin.fileno()) == os.getpgrp():
            self._fd = sys.stdin.fileno()
            self._before = termios.tcgetattr(self._fd)
            tty.setcbreak(self._fd)  # keys come at once and are not shown; Ctrl+C works as always
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if self._before:
            with suppress(termios.error):  # the terminal is gone
                termios.tcsetattr(self._fd, termios.TCSADRAIN, self._before)
            self._before = []

    def pressed(self) -> list[str]:
        """The words of the keys pressed since last time."""
        words = []
        while self._before and select([self._fd], [], [], 0)[0]:
            key = os.read(self._fd, 64)
            if not key:  # the terminal is gone
                self._before = []
            words += [KEYS[letter] for letter in key.decode("ascii", "ignore").lower() if letter in KEYS]
        return words
