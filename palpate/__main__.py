"""Entry point of the `palpate` command: fixes the environment that makes results repeatable, then runs the command.

If the environment lacks the values of `FIXED`, the interpreter is restarted with them before anything heavy is imported. Ctrl-C
during this time is kept until the command can report it.
"""

import os
import signal
import sys
from types import FrameType

from palpate.environment import FIXED
from palpate_errors import ExitStatus

TERMINALS = [number for number in (0, 1, 2) if os.isatty(number)]
"""File descriptors of standard input, output and error that are terminals."""


def main() -> None:
    """Run the command in an environment that makes its runs repeatable."""
    if any(os.environ.get(name) != value for name, value in FIXED.items()):
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # until the interpreter is up again
        os.execve(sys.executable, [sys.executable, "-m", "palpate", *sys.argv[1:]], {**os.environ, **FIXED})
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # `docker stop`, systemd: as Ctrl-C
    if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:  # nohup
        signal.signal(signal.SIGHUP, _hung_up)
    try:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
        _run()
    except KeyboardInterrupt:
        pass
    except SystemExit as left:
        if left.code != ExitStatus.INTERRUPTED:
            raise
    else:
        return
    print("palpate: interrupted", file=sys.stderr)
    sys.exit(ExitStatus.INTERRUPTED)


def _hung_up(number: int, frame: FrameType | None) -> None:
    """Treat a closed terminal as Ctrl-C, and redirect output so that writing does not fail."""
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
