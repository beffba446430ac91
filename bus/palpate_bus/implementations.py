"""Implementations of roles: a service's `create(scenario)`, selected by `services.<role>` of the scenario.

A choice is the name of an entry point in the group `palpate.<role>`, or the path of a Python file. Functions raise PluginError.
"""

from typing import Any

from palpate_bus.service import Service
from palpate_plugins import PluginError, PluginKind, is_file


def kind(role: str) -> PluginKind:
    """Return the plug-ins that may play a role."""
    return PluginKind(role, f"services.{role}")


def create(role: str, choice: str, scenario: Any) -> Service:
    """Return the service of a role for a scenario. Exceptions of an installed implementation's `create` pass through."""
    make = kind(role).load(choice)
    try:
        service = make(scenario)
    except (Exception, SystemExit) as error:
        if not is_file(choice) and not isinstance(error, ModuleNotFoundError | SystemExit):
            raise
        raise kind(role).failure(choice, error) from error
    if not isinstance(service, Service):
        raise PluginError(f"services.{role} = {choice!r}: create() returned {service!r}, expected a palpate_bus.service.Service")
    if service.role != role:
        raise PluginError(f"services.{role} = {choice!r}: makes a service of the role {service.role!r}")
    return service
