"""Tissue service with the elastic tissue."""

from palpate_bus.contract import contract
from palpate_bus.messages.stamps import NS
from palpate_bus.service import Service
from palpate_errors import UserError
from palpate_models.patient.breathing import BreathingCurve
from palpate_models.patient.phantom import build_phantom
from palpate_models.scenario.load import true_pose
from palpate_models.scenario.schema import Scenario
from palpate_plugins import PluginError
from palpate_tissue.backends.elastic.compliance import COMPLIANCE, compliance
from palpate_tissue.backends.elastic.tissue import ElasticTissue
from palpate_tissue.moving import carried
from palpate_tissue.service import TissueService

LEAST_LAYERS = 5
"""Layers of finite elements in a body from a grid file."""


def create(scenario: Scenario, pitch_m: float = COMPLIANCE.pitch_m) -> Service:
    """Return the elastic tissue of a scenario. The first time takes half a minute; the compliance is cached.

    `pitch_m` is the edge of the finite elements. Raises PluginError for a mesh that is too large.
    """
    phantom = scenario.phantom
    model = build_phantom(phantom, scenario.seed)
    thickness = None
    if phantom.grid is not None:  # it may be thinner than an abdomen, and its surface does not show how thick it is
        thickness = phantom.size_m[2]
        pitch_m = min(pitch_m, thickness / LEAST_LAYERS)
    try:
        body = compliance(model, phantom.lesions, thickness, pitch_m=pitch_m)
    except UserError as error:
        raise PluginError(str(error)) from error
    tissue = ElasticTissue(
        model,
        body,
        phantom.stiffness,
        BreathingCurve(phantom.breathing, scenario.seed),
        contract().roles[TissueService.role].period / NS,
    )
    facts = {
        "physics": "elastic solid",
        "free_vertices": len(body.free),
        "lesion_depths_m": [lesion.depth_m for lesion in phantom.lesions],
    }
    return carried(TissueService(tissue, model, true_pose(scenario), facts), scenario)
