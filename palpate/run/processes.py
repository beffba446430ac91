"""Local processes of a run. The list of processes is docker-compose.yml, as for containers."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from time import monotonic
from typing import IO, Any, NamedTuple

from palpate.apart import describe_end
from palpate.environment import FIXED, set_environment
from palpate.run.group import Groups, group_command
from palpate.run.options import Record
from palpate.service import command as service_command
from palpate_bus.contract import CONDUCTOR, contract
from palpate_bus.runs.announcement import Announcement, Run
from palpate_bus.runs.run_folder import RunFolder, remove_leftovers
from palpate_bus.security.access import ROUTER, access_control
from palpate_bus.security.keys import init, read
from palpate_bus.settings import BusConfigError, Settings, variable
from palpate_bus.wire.rmw import make_key
from palpate_bus.wire.zenoh_config import BusOptions, free_port, mesh, session
from palpate_conductor.outcome import Timing
from palpate_errors import UserError, restate
from palpate_inputs import read_yaml
from palpate_models.scenario.load import view_of


class SecureBus(NamedTuple):
    """A router for one run with mutual TLS, on which each role has the rights of its contract row."""

    keys: Path
    """Folder of all certificates, absolute."""
    endpoint: str

    def options(self, role: str) -> BusOptions:
        """Return the bus options of a role. Raises BusConfigError if its certificate is missing, expired or of another role."""
        options = BusOptions(mode="client", router=self.endpoint, tls=self.keys / role, shared_memory=False)
        certificate = read(self.keys / role / "cert.pem")
        if certificate.expired or certificate.name != role:
            found = f"is of {certificate.name!r}, valid until {certificate.until:%Y-%m-%d}"
            wanted = f"expected a valid one of {role!r}: palpate keys init {self.keys}"
            raise BusConfigError(f"{certificate.path}: {found}; {wanted}")
        return options


@contextmanager
def secure_bus(keys: Path | None = None) -> Iterator[SecureBus]:
    """Start a router for a `with` block. Raises BusConfigError.

    `keys`: a folder made by `palpate keys init`; by default keys are made for this run alone.
    """
    with ExitStack() as stack:
        if keys is None:
            own = RunFolder()  # if this process is killed, the next command removes the folder
            stack.callback(own.remove)
            keys = own.path / "keys"
            init(keys, days=2)
        bus = SecureBus(keys.resolve(), f"tls/127.0.0.1:{free_port()}")
        stack.enter_context(
            session(BusOptions(mode="router", listen=(bus.endpoint,), tls=bus.keys / ROUTER), access_control(contract()))
        )
        yield bus


COMPOSE = "docker-compose.yml"
BARRIER = frozenset(("robot", "control", "tissue"))
"""Roles of the 1 kHz loop. Processes with only these use the low-latency transport (see palpate_bus.wire.zenoh_config)."""


class ServiceProcess(NamedTuple):
    """A service of the compose file: its role, command and environment."""

    role: str
    command: tuple[str, ...]
    environment: Mapping[str, str]

    @property
    def words(self) -> tuple[str, ...] | None:
        """Return the words after `python -m palpate.service ROLE`; None for another program."""
        ours = service_command(self.role)
        return self.command[len(ours) :] if self.command[: len(ours)] == ours else None

    def shared_words(self) -> tuple[str, ...]:
        """Return `words` for a shared process. Raises UserError for a program that cannot share one."""
        if self.words is None:
            raise UserError(f"{self.role} is played by `{' '.join(self.command)}`, which cannot share a process")
        return self.words


def compose_file() -> Path:
    """Return the compose file: PALPATE_COMPOSE, else that of the checkout or of the installed package. Raises UserError."""
    package = Path(__file__).resolve().parents[1]
    candidates = Settings.read().compose[:1] or (package.parent / COMPOSE, package / COMPOSE)
    for path in candidates:
        if path.is_file():
            return path
    raise UserError(f"no {COMPOSE} found; looked for {', '.join(map(str, candidates))}. Set PALPATE_COMPOSE")


def read_processes(path: Path, roles: tuple[str, ...], overrides: Sequence[Path] | None = None) -> dict[str, ServiceProcess]:
    """Return the processes of `roles`, in that order, from a compose file and overrides, merged as by `docker compose -f -f`:
    a later file replaces the command and adds to the environment. By default the overrides are the files that PALPATE_COMPOSE
    names after the first.

    Raises UserError naming what is missing or malformed.
    """
    found: dict[str, ServiceProcess] = {}
    for file in (path, *(Settings.read().compose[1:] if overrides is None else overrides)):
        services = _services(file)
        for role in roles:
            service = services.get(role)
            if service is None and role not in found:
                raise UserError(f"{file}: no service {role!r}; it has {', '.join(services)}")
            if service is not None:
                found[role] = _merge(file, role, service, found.get(role, ServiceProcess(role, (), {})))
    return found


def _services(path: Path) -> dict[str, Any]:
    with restate(OSError, UserError, f"{path}: cannot be read"):
        document = read_yaml(path)
    return _mapping(document.get("services") if isinstance(document, dict) else document, f"{path}: services")


def _mapping(value: Any, name: str) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise UserError(f"{name} = {value!r}: expected a mapping")
    return value


def _merge(path: Path, role: str, service: Any, earlier: ServiceProcess) -> ServiceProcess:
    name = f"{path}: services.{role}"
    command = _mapping(service, name).get("command", list(earlier.command))
    if not command or not isinstance(command, list) or not all(isinstance(word, str) for word in command):
        raise UserError(f"{name}.command = {command!r}: expected a list of words")
    environment = _mapping(service.get("environment") or {}, f"{name}.environment")
    return ServiceProcess(role, tuple(command), {**earlier.environment, **{k: str(v) for k, v in environment.items()}})


_LOGGED = re.compile(r"^\d{4}-\d\d-\d\d [\d:,.]+ \S+ [A-Z]+ ")
"""Time, role and level before a message in a service's log."""
_TRACEBACK = "Traceback (most recent call last)"
MESSAGE_LINES = 20
"""Lines of a message that are shown; more are in the log."""


def how(code: int, log: Path) -> str:
    """Return how a process ended as text: its signal, or its exit status `code` and the last message of its log."""
    if code < 0:
        return describe_end(code)
    text = ""
    with suppress(OSError):
        text = log.read_text(encoding="utf-8", errors="replace")
    hint = "" if code else ": does it call palpate_bus.run.run_service?"
    said = _last_message(text) or f"its log is empty{hint}"
    return f"{describe_end(code)}: {said}"


def _last_message(text: str) -> str:
    """Return the last message of a log, of all its lines; of a traceback, what was raised."""
    lines = [line for line in text.splitlines() if line.strip()]
    begins = [k for k, line in enumerate(lines) if _LOGGED.match(line) or line.startswith(_TRACEBACK)]
    message = lines[begins[-1] if begins else -1 :]
    if message and message[0].startswith(_TRACEBACK):
        message = message[max(k for k, line in enumerate(message) if line.startswith((" ", _TRACEBACK))) + 1 :]
    return " ".join(_LOGGED.sub("", line.strip()) for line in message[:MESSAGE_LINES])


class LocalProcesses:
    """Service processes on this machine, each with its log file. The bus uses unix sockets in a private folder."""

    def __init__(
        self,
        groups: Groups,
        out: Path,
        scenario_files: Mapping[str, Path],
        timing: Timing,
        record: Record = "none",
        secure: SecureBus | None = None,
    ) -> None:
        """Prepare the processes.

        Args:
            groups: roles of each process.
            out: results folder.
            scenario_files: the scenario file that each role may see.
            timing: how time passes.
            record: what the run's recorder keeps.
            secure: router of which all processes are clients.
        """
        settings = Settings.read()
        taking_part = {role for group in groups for role in group}
        absent = tuple(name for name, role in contract().roles.items() if role.optional and name not in taking_part)
        self._out = out
        remove_leftovers()
        self._own = RunFolder()
        self.folder = self._own.path
        """Folder of sockets and key, removed at the end."""
        key = settings.key or make_key(self.folder / "run.key")
        time: dict[str, Any] = {"runtime": timing.runtime, "rate": timing.wallclock_rate}
        self._given: dict[str, Any] = {**time, "record": record, "absent": absent, "key": key}
        own = {role for role in scenario_files if view_of(role) == "scenario"}
        self._scenario_files = {role: file if role in own else self._copy(file) for role, file in scenario_files.items()}
        router = secure.endpoint if secure else settings.router
        processes = {group[0]: group for group in ((CONDUCTOR,), *groups)}
        quick = [name for name, roles in processes.items() if BARRIER.issuperset(roles)]
        bus = mesh(tuple(processes), self.folder, lowlatency=quick)
        self.bus = {role: replace(bus[name], router=router) for name, roles in processes.items() for role in roles}
        """Bus options of each role and the conductor: unix sockets, and a router if PALPATE_ROUTER names one."""
        endpoints = {role: options.listen[0] for role, options in self.bus.items()}
        if secure is not None:
            self.bus = {role: secure.options(role) for role in self.bus}
            endpoints = dict.fromkeys(self.bus, secure.endpoint)
        (out / "bus.json").write_text(json.dumps(endpoints, indent=2) + "\n", encoding="utf-8")
        secrets: dict[str, Any] = {"keys": None if secure is None else str(secure.keys), "key": str(key)}
        run = Run(out.name, endpoints, settings.domain, router=router, out=str(out), **time, **secrets)
        self._announcement = Announcement(run)
        self._logs: list[IO[bytes]] = []
        self.running: dict[str, subprocess.Popen[bytes]] = {}
        """By role; roles of one group share a process."""
        self._log_files: dict[str, Path] = {}
        self._ends: dict[str, str] = {}

    def _copy(self, file: Path) -> Path:
        """Copy a scenario file into a neutral folder: the name of the results folder may reveal the patient."""
        folder = self.folder / file.stem
        folder.mkdir(exist_ok=True)
        return Path(shutil.copy(file, folder))

    def environment(self, process: ServiceProcess) -> dict[str, str]:
        """Return the environment of a service beyond that of this process."""
        out = self._out if contract().roles[process.role].observer else None  # observers write into the results folder
        files = {"scenario": self._scenario_files[process.role], "out": out}
        settings = Settings.read({**os.environ, **process.environment}).replace(**files, **self._given)
        return {**process.environment, **FIXED, **settings.to_env(), **self.bus[process.role].to_env()}

    def as_conductor(self) -> AbstractContextManager[None]:
        """Set the run's key in the environment of this process within a `with` block."""
        return set_environment({variable("key"): str(self._given["key"])})

    def start(self, *processes: ServiceProcess) -> None:
        """Start a service, or several in one process. Raises UserError for a program that cannot share one."""
        roles = [process.role for process in processes]
        for role in roles:
            self._ends.pop(role, None)
        alone = len(processes) == 1
        command, given = (processes[0].command, self.environment(processes[0])) if alone else self._group(processes)
        path = self._out / "logs" / f"{'+'.join(roles)}.log"
        self._log_files |= dict.fromkeys(roles, path)
        self.running |= dict.fromkeys(roles, self._start(command, {**os.environ, **given}, path))

    def _group(self, processes: Sequence[ServiceProcess]) -> tuple[tuple[str, ...], dict[str, str]]:
        """Return command and common environment of services in one process. The group's file has the rest of each environment."""
        environments = {process.role: self.environment(process) for process in processes}
        common = dict(set.intersection(*(set(environment.items()) for environment in environments.values())))
        own = {role: dict(environment.items() - common.items()) for role, environment in environments.items()}
        words = {process.role: process.shared_words() for process in processes}
        return group_command(self.folder / f"{processes[0].role}.json", words, own), common

    def _start(self, command: tuple[str, ...], environment: dict[str, str], path: Path) -> subprocess.Popen[bytes]:
        log = path.open("wb")
        self._logs.append(log)
        return subprocess.Popen(
            [sys.executable if command[0] == "python" else command[0], *command[1:]],
            env=environment,
            stdout=log,
            stderr=subprocess.STDOUT,
            pass_fds=(self._own.lock,),
            process_group=0,  # only the conductor receives Ctrl-C: it ends the run, and the recorder closes its files
        )

    def ended(self) -> dict[str, str]:
        """Return how each ended process did so, by role: by a signal, or with a status and the last line of its log."""
        for role, child in self.running.items():
            if role not in self._ends and (code := child.poll()) is not None:
                self._ends[role] = how(code, self._log_files[role])
        return dict(self._ends)

    def stop(self, patience_s: float = 5.0, *, at_once: bool = False) -> None:
        """Wait for the processes to exit, then end the remaining ones with SIGTERM and SIGKILL; remove the sockets.

        Suspended processes are resumed, so that they receive the end of the run. `at_once`: kills without waiting; for a run that
        has not begun, whose services have nothing to complete and may still be importing.
        """
        steps: tuple[signal.Signals | None, ...] = (None, signal.SIGTERM, signal.SIGKILL)
        try:
            for child in self._remaining():
                child.send_signal(signal.SIGCONT)
            for send in steps[-1:] if at_once else steps:
                left = self._remaining()
                deadline = monotonic() + patience_s
                for child in left:
                    if send is not None:
                        child.send_signal(send)
                for child in left:
                    with suppress(subprocess.TimeoutExpired):
                        child.wait(timeout=max(0.0, deadline - monotonic()))
        finally:  # after Ctrl-C, too
            for child in self._remaining():
                child.send_signal(signal.SIGKILL)
            for log in self._logs:
                log.close()
            self._announcement.withdraw()
            self._own.remove()

    def _remaining(self) -> list[subprocess.Popen[bytes]]:
        """Return the processes that have not ended."""
        return [child for child in dict.fromkeys(self.running.values()) if child.poll() is None]
