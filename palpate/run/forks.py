"""Service processes forked from one that has imported everything: a campaign of many short runs pays for the imports once.

They are separate processes like any other, with their own session, log and signals; only who did the imports differs from a
fresh start. A single run starts fresh ones: there it would save nothing.
"""

from __future__ import annotations

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
    """What is asked of a service's process, as of `subprocess.Popen`."""

    pid: int

    def poll(self) -> int | None:
        """Its exit status, a signal's number as negative; None while it runs."""

    def send_signal(self, sig: int) -> None:
        """Sends it a signal, if it still runs."""

    def kill(self) -> None:
        """Ends it."""

    def wait(self, timeout: float | None = None) -> int:
        """Its exit status, once it has ended. Raises subprocess.TimeoutExpired."""


class Forked:
    """A forked process, as a `Child`."""

    def __init__(self, process: ForkServerProcess) -> None:
        """A process that was started."""
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
        """`modules` are imported once, by the fork server, which starts with the first process."""
        self._context = get_context("forkserver")
        self._context.set_forkserver_preload(["palpate.service", *modules])

    def start(self, command: Sequence[str], environment: Mapping[str, str], log: Path) -> Forked:
        """Starts `command`, which must be a Python module's, with that environment; what it prints goes to `log`.

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
    """In the child: what the shell and the interpreter would have done for `python -m WORDS > log`."""
    os.setpgid(0, 0)
    os.environ.clear()
    os.environ.update(environment)
    contract.cache_clear()  # the fork server may have read it for another run
    with Path(log).open("wb") as file:
        os.dup2(file.fileno(), sys.stdout.fileno())
        os.dup2(file.fileno(), sys.stderr.fileno())
    sys.argv = [*words]
    runpy.run_module(words[0], run_name="__main__", alter_sys=True)
