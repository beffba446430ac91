"""Ctrl-C in an examination: the first ends it and writes the results, the second prints a warning, the third exits at once."""

import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from dataclasses import dataclass
from threading import current_thread, main_thread
from types import FrameType

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
ANSWER = b"\npalpate: ending and writing the results, which takes some seconds; another Ctrl-C discards them\n"


@dataclass
class Ending:
    """State of the end of an examination."""

    measured: bool = False
    """True once all is measured: no Ctrl-C ends the examination any more."""
    asked: bool = False
    """True once an interruption was requested."""
    answered: bool = False


_CURRENT: ContextVar[Ending | None] = ContextVar("_CURRENT", default=None)


def all_is_measured() -> None:
    """Mark the measurement as finished; does nothing outside `results_first`."""
    if (ending := _CURRENT.get()) is not None:
        ending.measured = True


@contextmanager
def results_first() -> Iterator[Ending]:
    """Within it, the first Ctrl-C, SIGTERM or SIGHUP raises KeyboardInterrupt, until `all_is_measured`.

    After either, the next one prints a warning, and the one after raises KeyboardInterrupt. Other effects of the handlers are
    kept. Signals that do not interrupt, such as SIGHUP under nohup, stay as they are.
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
                os.write(2, ANSWER)  # without a library: the interrupted code may hold a lock, and standard error may be closed

    here = current_thread() is main_thread()  # only the main thread may set a handler, and only it is interrupted
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
