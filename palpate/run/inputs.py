"""What several commands are given, looked at before anything starts."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

import typer

from palpate.command_line import refuse
from palpate.run.implementations import NONE
from palpate_models.load import ScenarioError, load_scenario
from palpate_models.phantom import MeshError, build_phantom
from palpate_models.scenario import Scenario

Settings = Annotated[list[str] | None, typer.Option("--set", metavar="a.b=c", help="Overrides a field; may be repeated.")]
"""Overrides of a scenario."""


def usable(name: str, settings: Sequence[str] | None = None, seed: int | None = None) -> Scenario:
    """A scenario whose phantom can be made. Ends the command when there is none such."""
    try:
        scenario = load_scenario(name, settings or (), seed)
        if scenario.tissue.implementation != NONE:
            build_phantom(scenario.phantom, scenario.seed)
    except (ScenarioError, MeshError) as error:
        refuse(error)
    return scenario
