"""Other implementations of a role, chosen by `--set <role>.implementation=NAME`.

A package registers one as an entry point `<role>.<name>` in the group `palpate.implementations`; its value is the factory of the
service, and `python -m <its package>` is its process.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path

from palpate.run.processes import ServiceProcess
from palpate_models.load import ScenarioError
from palpate_models.scenario import Scenario

DEFAULT = "default"
NONE = "none"
"""Of the tissue: nothing plays the role, since what is examined is real."""


def _choices(scenario: Scenario) -> dict[str, str]:
    return {
        "tissue": scenario.tissue.implementation,
        "robot": scenario.robot.implementation,
        "camera": scenario.camera.implementation,
    }


def chosen_services(scenario: Scenario) -> dict[str, EntryPoint]:
    """The factories of the roles for which the scenario does not take the default.

    Raises ScenarioError that names the field, its value and what is allowed.
    """
    found = {point.name: point for point in entry_points(group="palpate.implementations")}
    chosen = {}
    for role, name in _choices(scenario).items():
        if name == DEFAULT or (role, name) == ("tissue", NONE):
            continue
        point = found.get(f"{role}.{name}")
        if point is None:
            known = sorted(key.partition(".")[2] for key in found if key.startswith(f"{role}."))
            allowed = [DEFAULT, *known, *([NONE] if role == "tissue" else [])]
            raise ScenarioError(f"{scenario.name}: {role}.implementation = {name!r}: allowed are {', '.join(allowed)}")
        chosen[role] = point
    return chosen


def chosen_processes(scenario: Scenario, processes: Mapping[str, ServiceProcess]) -> dict[str, ServiceProcess]:
    """The process list with the scenario's choices in place of the compose file's commands."""
    chosen = dict(processes)
    for role, point in chosen_services(scenario).items():
        package = point.module.rpartition(".")[0]
        chosen[role] = replace(chosen[role], command=("python", "-m", package))
    return chosen


class ImplementationError(ValueError):
    """An implementation that cannot be started. Names the option, its value and what is allowed."""


def installed_command(role: str, implementation: str, service: Path | None) -> tuple[str, ...] | None:
    """The words that start a chosen implementation or a file of one's own; None for the default. Raises ImplementationError."""
    if service is not None:
        if not service.is_file():
            raise ImplementationError(f"--service {service}: is no file")
        return ("python", str(service.resolve()))
    if implementation == DEFAULT:
        return None
    found = {point.name: point for point in entry_points(group="palpate.implementations")}
    point = found.get(f"{role}.{implementation}")
    if point is None:
        known = sorted(name.partition(".")[2] for name in found if name.startswith(f"{role}."))
        raise ImplementationError(f"--implementation {implementation}: for {role} there are {', '.join([DEFAULT, *known])}")
    return ("python", "-m", point.module.rpartition(".")[0])
