"""Ctrl-C in an examination: the first one ends it, the next is answered, since what would be lost is what was measured."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from dataclasses import dataclass
from threading import current_thread, main_thread
from types import FrameType
from typing import Final

SIGNALS: Final = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
ANSWER: Final = b"\npalpate: it is ending and writes its results, which takes some seconds; Ctrl-C once more, and they are lost\n"


@dataclass
class Ending:
    """How far the end of an examination is."""

    measured: bool = False
    """Whether all is measured: from then on no Ctrl-C is the one that ends it."""
    asked: bool = False
    """Whether somebody asked for the end."""
    answered: bool = False


_CURRENT: Final[ContextVar[Ending | None]] = ContextVar("_CURRENT", default=None)


def all_is_measured() -> None:
    """Says that what is left is to end and to write; does nothing outside `results_first`."""
    if (ending := _CURRENT.get()) is not None:
        ending.measured = True


@contextmanager
def results_first() -> Iterator[Ending]:
    """Within it, the first Ctrl-C, SIGTERM or SIGHUP raises KeyboardInterrupt, until `all_is_measured`.

    After either, one is answered with a sentence, and the next raises KeyboardInterrupt. What was done on a
    signal besides raising that is still done. Signals that do not interrupt, such as SIGHUP under nohup, stay as they are.
    """
    ending = Ending()

    def answer(number: int, frame: FrameType | None) -> None:
        try:
            before[signal.Signals(number)](number, frame)
        except KeyboardInterrupt:
            ends, ending.asked = not (ending.measured or ending.asked), True
            if ends or ending.answered:
                raise
            ending.answered = True
            with suppress(OSError):
                os.write(2, ANSWER)  # by no library: whatever it interrupts may hold a lock, and the reader may be gone

    here = current_thread() is main_thread()  # no other may set a handler, and none but it is interrupted
    handlers = {number: signal.getsignal(number) for number in SIGNALS if here}
    before = {number: handler for number, handler in handlers.items() if callable(handler)}
    for number in before:
        signal.signal(number, answer)
    token = _CURRENT.set(ending)
    try:
        yield ending
    finally:
        _CURRENT.reset(token)
        for number, handler in before.items():
            signal.signal(number, handler)
