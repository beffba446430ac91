"""Runs foreign code in a child process: it may exit, crash, hang or print without harm to the command.

The child is forked, so it has all that was imported and `work` may be any function. What it prints on standard output, by file
descriptor 1 too, goes to standard error.
"""

import ctypes
import mmap
import os
import pickle
import signal
import sys
import traceback
import warnings
from collections.abc import Callable, MutableSequence
from contextlib import suppress
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from queue import Empty, SimpleQueue
from threading import Thread
from time import monotonic, sleep
from types import FrameType
from typing import Any, Final, NoReturn, TypeVar, cast

from palpate_errors import RunError, UserError, restate

T = TypeVar("T")
Send = Callable[[Any], None]
"""Sends what can be pickled from the child to its parent."""
POLL_S: Final = 0.1
SIGNALS: Final = frozenset({signal.SIGINT, signal.SIGTERM, signal.SIGHUP})
PARENT_S: Final = 2.0
"""Time within which the parent interrupts a child whose group of processes got a signal."""
READ_S: Final = 5.0
"""Time to read the rest of what a child sent before it ended. A process that it has started may keep its pipe open."""
_LIBC: Final = ctypes.CDLL(None)
_PR_SET_PDEATHSIG: Final = 1
_OVER: Final = object()
"""Ends the news of a child."""


class ChildLost(RunError):
    """The child ended without a result, or it was killed because it was late. The text says how."""

    def __init__(self, text: str, late: bool = False) -> None:
        super().__init__(text)
        self.late = late


def describe_end(code: int) -> str:
    """Return how a process ended, from its exit status or minus its signal."""
    if code >= 0:
        return f"left with status {code}"
    name = {known.value: f" ({known.name})" for known in signal.Signals}.get(-code, "")
    return f"killed by signal {-code}{name}"


def shared_numbers() -> MutableSequence[int]:
    """Return whole numbers that this process shares with its children."""
    numbers: Any = memoryview(mmap.mmap(-1, mmap.PAGESIZE)).cast("q")
    return cast("MutableSequence[int]", numbers)


class TimeLimit:
    """Finds when a child stays at one place for too long. Time in which this process was stopped does not count."""

    def __init__(self, place: Callable[[], object], limit_s: Callable[[], float]) -> None:
        """`place`: where the child is; `limit_s`: how long it may be there [s]."""
        self._place, self._limit_s = place, limit_s
        self._last = place()
        self.there_s, self._checked = 0.0, monotonic()
        """Time for which the child has been at its present place."""

    def check(self) -> None:
        """Raise ChildLost when the child is late. Call it every `POLL_S`."""
        now, place = monotonic(), self._place()
        self.there_s = self.there_s + min(now - self._checked, 2 * POLL_S) if place == self._last else 0.0
        self._last, self._checked = place, now
        if self.there_s > self._limit_s():
            raise ChildLost(f"did not return within {self._limit_s():g} s", late=True)


def run_apart(
    work: Callable[[Send], T], receive: Callable[[Any], None] = lambda _: None, check: Callable[[], None] = lambda: None
) -> T:
    """Return what `work` returns in a child process. Raises the UserError, RunError or KeyboardInterrupt that it raises there.

    `receive` takes what the child sends, `check` is called every `POLL_S`; the child is killed if either raises. The first
    KeyboardInterrupt of the caller is raised in the child instead, which may still return a result.

    Raises ChildLost for another exception, and if the child ends otherwise.
    """
    result: T = _Child(work).result(receive, check)
    return result


def run_guarded(
    part: str, work: Callable[[], T], limit_s: float, error: type[Exception] = RunError, place: Callable[[], object] = tuple
) -> T:
    """Return what `work` returns in a child process. Raises `error` that names the part if that exits, crashes or hangs.

    `limit_s`: how long it may stay at one `place`.
    """
    with restate(ChildLost, error, part):
        return run_apart(lambda _: work(), check=TimeLimit(place, lambda: limit_s).check)


class _Child:
    def __init__(self, work: Callable[[Send], Any]) -> None:
        self._pipe, theirs = Pipe(duplex=False)
        self._news: SimpleQueue[Any] = SimpleQueue()
        self._answer: tuple[str, Any] | None = None
        self._unreadable: ChildLost | None = None
        """Set when a message cannot be unpickled: no later one is read."""
        self._code: int | None = None
        self._interrupted = shared_numbers()
        """Its first number is 1 once the parent interrupts the child."""
        for stream in (sys.stdout, sys.stderr):
            with suppress(OSError, ValueError):
                stream.flush()
        parent = os.getpid()
        mask = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)  # until the child has its own handlers
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", DeprecationWarning)  # threads of the parent, such as that of a progress bar
                self.pid = os.fork()
            if not self.pid:
                self._pipe.close()
                _serve(work, theirs, parent, mask, self._interrupted)
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        theirs.close()
        self._reader = Thread(target=self._read, daemon=True)  # which Ctrl-C does not interrupt in the middle of a message
        self._reader.start()

    def _read(self) -> None:
        try:
            while self._answer is None:
                kind, value = self._pipe.recv()
                if kind == "news":
                    self._news.put(value)
                else:
                    self._answer = (kind, value)
        except (EOFError, OSError):  # the child has ended, or closed its pipe
            pass
        except Exception as error:  # any: unpickling imports modules and runs code
            self._unreadable = ChildLost(f"sent what cannot be read: {type(error).__name__}: {error}")
        self._news.put(_OVER)

    def result(self, receive: Callable[[Any], None], check: Callable[[], None]) -> Any:
        try:
            while True:
                try:
                    reading = self._reader.is_alive()
                    self._receive(receive)
                    answered = not reading and (self._answer or self._unreadable) is not None
                    if answered or self._ended(os.WNOHANG):
                        break
                    check()
                except KeyboardInterrupt:
                    if self._interrupted[0]:
                        raise
                    self._interrupted[0] = 1
                    with suppress(ProcessLookupError):
                        os.kill(self.pid, signal.SIGTERM)
            if reading:
                self._reader.join(READ_S)
                self._receive(receive)
        finally:
            if self._answer is None and not self._ended(os.WNOHANG):
                os.kill(self.pid, signal.SIGKILL)
            self._ended(0)
        if self._answer is None:
            raise self._unreadable or ChildLost(describe_end(self._code or 0))
        kind, value = self._answer
        if kind == "raised":
            raise value
        return value

    def _receive(self, receive: Callable[[Any], None]) -> None:
        """Pass on what was received in the next `POLL_S`."""
        with suppress(Empty):
            news = self._news.get(timeout=POLL_S)
            while news is not _OVER:
                receive(news)
                news = self._news.get_nowait()

    def _ended(self, options: int) -> bool:
        if self._code is None:
            pid, status = os.waitpid(self.pid, options)
            if pid:
                self._code = os.waitstatus_to_exitcode(status)
        return self._code is not None


def _serve(work: Callable[[Send], Any], pipe: Connection, parent: int, mask: Any, interrupted: MutableSequence[int]) -> NoReturn:
    """Act in the child: work, send the result and exit."""

    def interrupt(number: int, _: FrameType | None) -> NoReturn:
        signal.signal(number, signal.SIG_IGN)  # once: a group of processes may be ended as one
        end = monotonic() + PARENT_S
        while not interrupted[0] and monotonic() < end:
            sleep(0.01)
        if interrupted[0]:
            raise KeyboardInterrupt
        raise ChildLost(f"raised signal {number} ({signal.Signals(number).name}) itself")

    try:
        _LIBC.prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != parent:
            os._exit(1)
        for number in (signal.SIGINT, signal.SIGHUP):  # the parent gets them, too, and ends the child
            signal.signal(number, signal.SIG_IGN)
        signal.signal(signal.SIGTERM, interrupt)
        os.dup2(2, 1)
        sys.stdout = sys.stderr
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        try:
            answer = ("done", work(lambda news: pipe.send(("news", news))))
        except BaseException as error:
            swallowed = interrupted[0] and not isinstance(error, UserError | RunError)  # by a library, which then failed
            answer = ("raised", KeyboardInterrupt() if swallowed else _portable(error))
        pipe.send(answer)
    except BaseException as error:  # such as a result that cannot be pickled
        with suppress(OSError):
            pipe.send(("raised", ChildLost(f"sends no result: {type(error).__name__}: {error}")))
    finally:
        for stream in (sys.stdout, sys.stderr):
            with suppress(OSError, ValueError):
                stream.flush()
        os._exit(0)


def _portable(error: BaseException) -> BaseException:
    """Return an exception that can be sent. The traceback of an unexpected one is printed."""
    if not isinstance(error, UserError | RunError | KeyboardInterrupt):
        if not isinstance(error, SystemExit):
            traceback.print_exception(error)
        return ChildLost(f"raised {type(error).__name__}: {error}")
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:
        return (UserError if isinstance(error, UserError) else RunError)(str(error))
    return error
