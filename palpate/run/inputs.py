"""What several commands are given, looked at before anything starts."""

from __future__ import annotations

from collections.abc import Sequence

from palpate.command_line import refuse
from palpate.run.region import scan_over, with_whole_path
from palpate.run.roles import NONE, checked, settings_of
from palpate_bus.implementations import ChoiceError
from palpate_models.patient.mesh import MeshError
from palpate_models.patient.phantom import build_phantom
from palpate_models.scenario.load import ScenarioError, load_scenario
from palpate_models.scenario.named_function import PatternError
from palpate_models.scenario.schema import Scenario


def usable(
    name: str,
    settings: Sequence[str] | None = None,
    seed: int | None = None,
    services: Sequence[str] | None = None,
    elsewhere: bool = False,
) -> Scenario:
    """A scenario whose phantom can be made and whose services there are. Ends the command for any other.

    `services` are choices ROLE=NAME_OR_FILE. With `elsewhere` the services run in containers or on other machines, so that they
    are not looked for here.
    """
    try:
        return examinable(load_scenario(name, [*(settings or ()), *settings_of(services or ())], seed), elsewhere)
    except MeshError as error:
        refuse(f"{name}: {error}")
    except (ScenarioError, PatternError, ChoiceError) as error:
        refuse(error)


def examinable(scenario: Scenario, elsewhere: bool = False) -> Scenario:
    """The scenario, after its phantom could be made and its services were found, unless they run `elsewhere`.

    Raises MeshError for a phantom that cannot be made, PatternError for a scan that cannot be made or leaves the body,
    ChoiceError for a service that there is not.
    """
    scenario = with_whole_path(scenario)
    if scenario.services.tissue != NONE:
        scan_over(scenario, build_phantom(scenario.phantom, scenario.seed))
    return scenario if elsewhere else checked(scenario)
