"""Services of one's own in place of ours: `palpate run --service ROLE=FILE.py`, without a package.

The file has `create(scenario)`, which gives the service, and as a script it calls `palpate_bus.run.main`, as ours do.
"""

from __future__ import annotations

import runpy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from palpate.run.processes import ServiceProcess
from palpate_bus.contract import contract
from palpate_bus.service import Service


class OwnServiceError(ValueError):
    """A service of one's own that cannot be used. Names the option's value and what is wanted."""


def own_services(options: Sequence[str]) -> dict[str, Path]:
    """From the values ROLE=FILE.py of `--service`. Raises OwnServiceError."""
    found = {}
    roles = [name for name, role in contract().roles.items() if name != "conductor"]
    for option in options:
        role, equals, name = option.partition("=")
        path = Path(name)
        if not equals or role not in roles:
            raise OwnServiceError(f"--service {option}: want ROLE=FILE.py with ROLE one of {', '.join(roles)}")
        if path.suffix != ".py" or not path.is_file():
            raise OwnServiceError(f"--service {option}: {path} is no Python file")
        found[role] = path.resolve()
    return found


def in_place(processes: Mapping[str, ServiceProcess], own: Mapping[str, Path]) -> dict[str, ServiceProcess]:
    """The processes with one's own in place of ours; a role that this run does not have is left out."""
    return {
        role: replace(process, command=("python", str(own[role]))) if role in own else process
        for role, process in processes.items()
    }


def load(role: str, path: Path) -> Callable[[Any], Service]:
    """The `create` of a file. Raises OwnServiceError when it has none."""
    create = runpy.run_path(str(path), run_name=f"own_{role}").get("create")
    if not callable(create):
        raise OwnServiceError(f"--service {role}={path}: the file has no function create(scenario)")
    made: Callable[[Any], Service] = create
    return made
