"""Roles of a run, the implementation of each, and the scenario files that they may read."""

import json
from collections.abc import Sequence
from pathlib import Path

from palpate.apart import run_guarded
from palpate.run.options import Record
from palpate_bus import implementations
from palpate_bus.contract import contract
from palpate_bus.runs.run_folder import name_run
from palpate_bus.settings import Settings
from palpate_errors import restate
from palpate_models.scenario.load import HIDDEN, dump_scenario, view_of
from palpate_models.scenario.schema import Scenario, Services
from palpate_models.section import did_you_mean
from palpate_plugins import PluginError, is_file
from palpate_search.posterior import POLICY, policy
from palpate_search.service import try_policy

_ROLES = contract().served
ROLES = tuple(_ROLES)
"""All roles but the conductor."""
WORKERS = tuple(name for name, role in _ROLES.items() if not (role.observer or role.optional))
"""The roles of every examination."""
OBSERVERS = tuple(name for name, role in _ROLES.items() if role.observer)
NONE = "none"
"""`services.tissue: none`: the tissue is real and has no service."""


def workers(scenario: Scenario) -> tuple[str, ...]:
    """Return the roles that a run of this scenario needs: without the tissue if that is real, with the search if it searches, and
    with other optional roles that have an implementation.
    """
    chosen = (role for role, row in _ROLES.items() if row.optional and role != "search" and choice(scenario, role) != "default")
    searching = ("search",) if scenario.exam.searched else ()
    return (*(role for role in WORKERS if role != "tissue" or scenario.services.tissue != NONE), *searching, *chosen)


def read_record(observers: Sequence[str]) -> Record:
    """Return what the recorder of a run keeps: the setting, by default `normal`; `none` without a recorder."""
    if "recorder" not in observers:
        return "none"
    said = Settings.read().record
    return "normal" if said == "none" else said


def choice(scenario: Scenario, role: str) -> str:
    """Return the implementation that the scenario names for a role."""
    return str(getattr(scenario.services, role, "default"))


def settings_of(options: Sequence[str]) -> list[str]:
    """Return the settings for `--service ROLE=NAME_OR_FILE`. Raises PluginError for an unknown role."""
    settings = []
    for option in options:
        role, equals, name = option.partition("=")
        if not equals or role not in _ROLES:
            roles = f"{', '.join(_ROLES)}{did_you_mean(role, _ROLES)}"
            raise PluginError(f"--service {option}: expected ROLE=NAME_OR_FILE with ROLE one of {roles}")
        settings.append(f"services.{role}={json.dumps(name)}")
    return settings


def check_choices(scenario: Scenario) -> Scenario:
    """Return the scenario with absolute paths of user-defined services, after all its choices were checked.

    Raises PluginError that names the scenario, the field, its value and what is allowed, RecordingError for a camera's recording.
    """
    services = {role: choice(scenario, role) for role in _ROLES}
    for role in scenario.services.model_extra or {}:
        if role not in _ROLES:
            known = f"it has {', '.join(_ROLES)}{did_you_mean(role, _ROLES)}"
            raise PluginError(f"{scenario.name}: services.{role}: the contract has no such role; {known}")
    for role, name in services.items():
        if (role, name) == ("tissue", NONE) or (name == "default" and _ROLES[role].optional and role not in workers(scenario)):
            continue
        with restate(PluginError, PluginError, scenario.name):
            implementations.kind(role).check(name)
            if role not in OBSERVERS:  # a run without the dashboard's libraries has no dashboard
                implementations.kind(role).check_libraries(name)
        if is_file(name):
            services[role] = str(Path(name).resolve())
    _check_fmu(scenario)
    if services["camera"] == "replay":  # now, not after all processes have started
        implementations.create("camera", "replay", scenario)
    search = scenario.search
    if scenario.exam.searched:
        with restate(PluginError, PluginError, scenario.name):
            _check_policy(scenario)
        if is_file(search.policy):
            search = search.model_copy(update={"policy": str(Path(search.policy).resolve())})
    return scenario.model_copy(update={"services": Services.model_validate(services), "search": search})


def _check_policy(scenario: Scenario) -> None:
    """Raise PluginError for a policy that cannot be loaded, or a user's whose first press is not usable."""
    name = scenario.search.policy
    if not POLICY.foreign(name):
        policy(name)
        return
    part = f"search.policy = {name!r}"
    run_guarded(part, lambda: try_policy(scenario), Settings.read().start_limit_s, PluginError)


def foreign_roles(scenario: Scenario) -> frozenset[str]:
    """Return the roles whose service, or a part of it, is not of this package."""
    found = {role for role in _ROLES if implementations.kind(role).foreign(choice(scenario, role))}
    if choice(scenario, "tissue") == "fmu" and scenario.tissue.fmu:
        found.add("tissue")
    if scenario.exam.searched and POLICY.foreign(scenario.search.policy):
        found.add("search")
    return frozenset(found)


def _check_fmu(scenario: Scenario) -> None:
    """Raise PluginError if an FMU or a map of its variables is missing, or the file is not an FMU."""
    for field, given in (("fmu", scenario.tissue.fmu), ("fmu_map", scenario.tissue.fmu_map)):
        if given and not Path(given).is_file():
            raise PluginError(f"{scenario.name}: tissue.{field} = {given!r}: there is no such file")
    if given := scenario.tissue.fmu:
        from palpate_fmu.reading import FmuError, open_fmu  # noqa: PLC0415 - images of other roles lack its libraries

        with restate(FmuError, PluginError, f"{scenario.name}: tissue.fmu = {given!r}"), open_fmu(Path(given)):
            pass


def write_scenario_files(scenario: Scenario, out: Path) -> dict[str, Path]:
    """Make the results folder with its run's name and scenario files. Return the file that each role may read.

    Only scenario.yaml names the run, so that the inputs of the examination do not depend on its time.
    """
    (out / "logs").mkdir(parents=True, exist_ok=True)
    named = f"# run {name_run(out)}\n"
    for view in HIDDEN:
        text = dump_scenario(scenario, view)
        (out / f"{view}.yaml").write_text(named + text if view == "scenario" else text, encoding="utf-8")
    return {role: out / f"{view_of(role)}.yaml" for role in _ROLES}
