"""Service processes forked from one that has imported everything, so that a campaign of many short runs imports once.

Each has its own session, log and signals, as a process started afresh. A single run would save nothing and does not use this.
"""

import os
import runpy
import subprocess
import sys
from collections.abc import Iterable, Mapping, Sequence
from multiprocessing import get_context
from multiprocessing.context import ForkServerProcess
from pathlib import Path
from typing import Protocol

from palpate_bus.contract import contract


class Child(Protocol):
    """The part of the interface of `subprocess.Popen` that is used."""

    pid: int

    def poll(self) -> int | None:
        """Return the exit status, negative for a signal; None while it runs."""

    def send_signal(self, sig: int) -> None:
        """Send a signal if it still runs."""

    def kill(self) -> None:
        """Kill it."""

    def wait(self, timeout: float | None = None) -> int:
        """Wait for its end; return the exit status. Raises subprocess.TimeoutExpired."""


class Forked:
    """A forked process, as a `Child`."""

    def __init__(self, process: ForkServerProcess) -> None:
        """`process` has been started."""
        assert process.pid is not None
        self._process = process
        self.pid = process.pid

    def poll(self) -> int | None:
        """See `Child`."""
        return self._process.exitcode

    def send_signal(self, sig: int) -> None:
        """See `Child`."""
        if self.poll() is None:
            os.kill(self.pid, sig)

    def kill(self) -> None:
        """See `Child`."""
        self._process.kill()

    def wait(self, timeout: float | None = None) -> int:
        """See `Child`."""
        self._process.join(timeout)
        status = self.poll()
        if status is None:
            raise subprocess.TimeoutExpired(str(self._process.name), timeout or 0.0)
        return status


class Forks:
    """Starts `python -m PACKAGE [WORD]` by forking."""

    def __init__(self, modules: Iterable[str]) -> None:
        """The fork server, which starts with the first process, imports `modules` once."""
        self._context = get_context("forkserver")
        self._context.set_forkserver_preload(["palpate.service", *modules])

    def start(self, command: Sequence[str], environment: Mapping[str, str], log: Path) -> Forked:
        """Start `command`, which must be a Python module's, with that environment; what it prints goes to `log`.

        Raises ValueError for another command.
        """
        if len(command) < len(("python", "-m", "package")) or command[1] != "-m":
            raise ValueError(f"{' '.join(command)}: only python -m PACKAGE can be forked")
        process = self._context.Process(
            target=_become, args=(tuple(command[2:]), dict(environment), str(log)), name=command[2], daemon=True
        )
        process.start()
        return Forked(process)


def _become(words: Sequence[str], environment: Mapping[str, str], log: str) -> None:
    """Act in the child as shell and interpreter for `python -m WORDS > log`."""
    os.setpgid(0, 0)
    os.environ.clear()
    os.environ.update(environment)
    contract.cache_clear()  # the fork server may have read it for another run
    with Path(log).open("wb") as file:
        os.dup2(file.fileno(), sys.stdout.fileno())
        os.dup2(file.fileno(), sys.stderr.fileno())
    sys.argv = [*words]
    runpy.run_module(words[0], run_name="__main__", alter_sys=True)
