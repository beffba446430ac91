"""Secure mode of a local run: every process is a client of one router over mutual TLS, with the rights of its contract row."""

from __future__ import annotations

from pathlib import Path
from types import TracebackType
from typing import Self

from palpate_bus.contract import contract
from palpate_bus.runs.run_folder import RunFolder
from palpate_bus.security.access import ROUTER, access_control
from palpate_bus.security.keys import init, read
from palpate_bus.wire.zenoh_config import BusConfigError, BusOptions, close_session, free_port, open_session


class SecureBus:
    """A secure router for one run; use it as a context manager."""

    def __init__(self, keys: Path | None = None) -> None:
        """`keys`: a folder made by `palpate keys init`; by default keys are made for this run alone."""
        self._own: RunFolder | None = None
        if keys is None:  # if this process is killed, the next command removes the folder
            self._own = RunFolder()
            keys = self._own.path / "keys"
        self.keys = keys.resolve()
        self.endpoint = f"tls/127.0.0.1:{free_port()}"

    def options(self, role: str) -> BusOptions:
        """Return the bus options of a role. Raises BusConfigError if its certificate is missing, expired or of another role."""
        options = BusOptions(mode="client", router=self.endpoint, tls=self.keys / role, shared_memory=False)
        certificate = read(self.keys / role / "cert.pem")
        if certificate.expired or certificate.name != role:
            raise BusConfigError(
                f"{certificate.path}: is of {certificate.name!r}, valid until {certificate.until:%Y-%m-%d}; "
                f"want a valid one of {role!r}: palpate keys init {self.keys}"
            )
        return options

    def __enter__(self) -> Self:
        """Starts the router. Raises BusConfigError."""
        try:
            if self._own is not None:
                init(self.keys, days=2)
            options = BusOptions(mode="router", listen=(self.endpoint,), tls=self.keys / ROUTER)
            self._router = open_session(options, access_control(contract()))
        except BaseException:
            self._remove_own_keys()
            raise
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        close_session(self._router)
        self._remove_own_keys()

    def _remove_own_keys(self) -> None:
        """Removes keys that were made for this run alone."""
        if self._own is not None:
            self._own.remove()
