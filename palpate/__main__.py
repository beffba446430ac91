"""Entry point of the `palpate` command: fixes the environment that makes results repeatable, then runs the command.

Where the environment does not have the values of `FIXED` yet, the interpreter is started again with them, before anything heavy
is imported. Ctrl-C while that goes on is kept until the command can tell of it.
"""

from __future__ import annotations

import os
import signal
import sys
from types import FrameType

from palpate.environment import FIXED

EXIT_INTERRUPTED = 130
"""What a shell makes of a command that SIGINT ended, and what Typer leaves with then."""

TERMINALS = [number for number in (0, 1, 2) if os.isatty(number)]
"""Which of standard input, output and error are terminals."""


def main() -> None:
    """Runs the command in an environment that makes its runs repeatable."""
    if any(os.environ.get(name) != value for name, value in FIXED.items()):
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # until the interpreter is up again
        os.execve(sys.executable, [sys.executable, "-m", "palpate", *sys.argv[1:]], {**os.environ, **FIXED})
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # `docker stop`, systemd: what Ctrl-C does
    if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:  # nohup
        signal.signal(signal.SIGHUP, _hung_up)
    try:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
        _run()
    except KeyboardInterrupt:
        pass
    except SystemExit as left:
        if left.code != EXIT_INTERRUPTED:
            raise
    else:
        return
    print("palpate: interrupted", file=sys.stderr)
    sys.exit(EXIT_INTERRUPTED)


def _hung_up(number: int, frame: FrameType | None) -> None:
    """The terminal was closed, which is what Ctrl-C is; nothing is to fail because there is nobody to read."""
    for terminal in TERMINALS:
        if not os.isatty(terminal):
            os.dup2(os.open(os.devnull, os.O_RDWR), terminal)
    signal.default_int_handler(number, frame)


def _run() -> None:
    try:
        from palpate.commands import main as run  # noqa: PLC0415
    except ModuleNotFoundError as error:
        if error.name != "typer":
            raise
        sys.exit("palpate: bus and contract are installed, the command line is not: pip install 'palpate[run]'")
    run()


if __name__ == "__main__":
    main()
