"""Tissue service with the Winkler-Pasternak tissue, the default."""

from typing import Any

from palpate_bus.service import Service
from palpate_models.patient.motion import BreathingCurve
from palpate_models.patient.phantom import PhantomModel
from palpate_models.scenario.schema import Scenario
from palpate_tissue.backends.winkler.tissue import WinklerTissue
from palpate_tissue.service import simulated


def create(scenario: Scenario) -> Service:
    """Return the tissue of a scenario. Raises PluginError if this backend cannot simulate it."""

    def make(model: PhantomModel, breathing: BreathingCurve, period_s: float) -> tuple[WinklerTissue, dict[str, Any]]:
        tissue = WinklerTissue(model, scenario.phantom.stiffness, breathing, period_s)
        stability = round(tissue.dt * tissue.mechanics.rate, 4)  # passive below 2
        return tissue, {"stability_dt_rate": stability, "substeps": tissue.substeps}

    return simulated(scenario, make)
