"""The default tissue in its role."""

from __future__ import annotations

from palpate_bus.contract import contract
from palpate_bus.messages.stamps import NS
from palpate_bus.service import Service
from palpate_models.patient.breathing import BreathingCurve
from palpate_models.patient.phantom import build_phantom
from palpate_models.scenario.load import true_pose
from palpate_models.scenario.schema import Scenario
from palpate_plugins import PluginError
from palpate_tissue.backends.winkler.mechanics import StabilityError
from palpate_tissue.backends.winkler.tissue import WinklerTissue
from palpate_tissue.moving import carried
from palpate_tissue.service import TissueService


def create(scenario: Scenario) -> Service:
    """The tissue of a scenario; with scoring, the one role that may look at its phantom.

    Raises PluginError for one that this tier cannot simulate.
    """
    phantom = scenario.phantom
    model = build_phantom(phantom, scenario.seed)
    breathing = BreathingCurve(phantom.breathing, scenario.seed)
    try:
        tissue = WinklerTissue(model, phantom.stiffness, breathing, contract().roles[TissueService.role].period / NS)
    except StabilityError as error:
        raise PluginError(f"services.tissue = winkler: {error}") from error
    facts = {
        "stability_dt_rate": round(tissue.dt * tissue.mechanics.rate, 4),  # passive below 2
        "gershgorin_dt_rate": round(tissue.dt * tissue.mechanics.gershgorin, 4),
        "substeps": tissue.substeps,
    }
    return carried(TissueService(tissue, model, true_pose(scenario), facts), scenario)
