"""Tissue service with the Winkler-Pasternak tissue, the default."""

from palpate_bus.contract import contract
from palpate_bus.messages.stamps import NS
from palpate_bus.service import Service
from palpate_errors import UserError
from palpate_models.patient.breathing import BreathingCurve
from palpate_models.patient.phantom import build_phantom
from palpate_models.scenario.load import true_pose
from palpate_models.scenario.schema import Scenario
from palpate_plugins import PluginError
from palpate_tissue.backends.winkler.tissue import WinklerTissue
from palpate_tissue.moving import carried
from palpate_tissue.service import TissueService


def create(scenario: Scenario) -> Service:
    """Return the tissue of a scenario. Besides scoring, this is the only role that gets the phantom.

    Raises PluginError if this backend cannot simulate it.
    """
    phantom = scenario.phantom
    model = build_phantom(phantom, scenario.seed)
    breathing = BreathingCurve(phantom.breathing, scenario.seed)
    try:
        tissue = WinklerTissue(model, phantom.stiffness, breathing, contract().roles[TissueService.role].period / NS)
    except UserError as error:
        raise PluginError(f"services.tissue = winkler: {error}") from error
    facts = {
        "stability_dt_rate": round(tissue.dt * tissue.mechanics.rate, 4),  # passive below 2
        "substeps": tissue.substeps,
    }
    return carried(TissueService(tissue, model, true_pose(scenario), facts), scenario)
