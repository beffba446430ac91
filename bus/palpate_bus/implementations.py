"""Implementations of roles: a service's `create(scenario)`, selected by `services.<role>` of the scenario.

A choice is the name of an entry point in the group `palpate.<role>`, or the path of a Python file. Functions raise PluginError.
"""

from collections.abc import Callable
from typing import Any

from palpate_bus.service import Service
from palpate_plugins import PluginError, PluginKind, is_file

Create = Callable[[Any], Service]
"""Makes a service from a scenario."""


def kind(role: str) -> PluginKind:
    """Return the plug-ins that may play a role."""
    return PluginKind(role, f"services.{role}")


def names(role: str) -> tuple[str, ...]:
    """Return the installed implementations of a role."""
    return kind(role).names()


def check(role: str, choice: str) -> None:
    """Check that the implementation exists. Imports nothing."""
    kind(role).check(choice)


def check_libraries(role: str, choice: str) -> None:
    """Check that the libraries of an installed implementation can be imported."""
    kind(role).check_libraries(choice)


def create_for(role: str, choice: str) -> Create:
    """Return the function that makes the service."""
    return kind(role).load(choice)


def create(role: str, choice: str, scenario: Any) -> Service:
    """Return the service of a role for a scenario. Exceptions of an installed implementation's `create` pass through."""
    make = create_for(role, choice)
    try:
        service = make(scenario)
    except (Exception, SystemExit) as error:
        if not is_file(choice) and not isinstance(error, ModuleNotFoundError | SystemExit):
            raise
        raise kind(role).failure(choice, error) from error
    if not isinstance(service, Service):
        raise PluginError(f"services.{role} = {choice!r}: create() returned {service!r}, want a palpate_bus.service.Service")
    if service.role != role:
        raise PluginError(f"services.{role} = {choice!r}: makes a service of the role {service.role!r}")
    return service


def module(role: str, choice: str) -> str:
    """Return the name of the module that holds `create` of an installed implementation."""
    return kind(role).entry_point(choice).module
