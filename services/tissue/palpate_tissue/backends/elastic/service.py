"""Tissue service with the elastic tissue."""

from typing import Any

from palpate_bus.service import Service
from palpate_models.patient.motion import BreathingCurve
from palpate_models.patient.phantom import PhantomModel
from palpate_models.scenario.schema import Scenario
from palpate_tissue.backends.elastic.compliance import COMPLIANCE, compliance
from palpate_tissue.backends.elastic.tissue import ElasticTissue
from palpate_tissue.service import simulated

LEAST_LAYERS = 5
"""Layers of finite elements in a body from a grid file."""


def create(scenario: Scenario, pitch_m: float = COMPLIANCE.pitch_m) -> Service:
    """Return the elastic tissue of a scenario. The first time takes half a minute; the compliance is cached.

    `pitch_m` is the edge of the finite elements. Raises PluginError for a mesh that is too large.
    """
    phantom, thickness = scenario.phantom, None
    if phantom.grid is not None:  # it may be thinner than an abdomen, and its surface does not show how thick it is
        thickness = phantom.size_m[2]
        pitch_m = min(pitch_m, thickness / LEAST_LAYERS)

    def make(model: PhantomModel, breathing: BreathingCurve, period_s: float) -> tuple[ElasticTissue, dict[str, Any]]:
        body = compliance(model, phantom.lesions, thickness, pitch_m=pitch_m)
        depths = [lesion.depth_m for lesion in phantom.lesions]
        facts = {"physics": "elastic solid", "free_vertices": len(body.free), "lesion_depths_m": depths}
        return ElasticTissue(model, body, phantom.stiffness, breathing, period_s), facts

    return simulated(scenario, make)
