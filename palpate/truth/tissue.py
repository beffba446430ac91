"""True tissue of a scenario, of any implementation, for pressing without the bus."""

from typing import Final

from palpate_bus.implementations import create
from palpate_models.patient.motion import Motion
from palpate_models.scenario.schema import Scenario
from palpate_tissue.backend import TissueBackend
from palpate_tissue.service import TissueService

_OWN_FMU: Final = "winkler"
"""Tier with the equations of our own FMU."""


def true_tissue(scenario: Scenario) -> TissueBackend | None:
    """Return the tissue of a scenario at rest, on a body that does not move.

    None if it cannot be copied: a foreign FMU, a custom service, real tissue.
    """
    chosen = scenario.services.tissue
    if chosen == "none" or (chosen == "fmu" and scenario.tissue.fmu is not None):
        return None
    still = scenario.phantom.model_copy(update={"motion": Motion()})
    service = create("tissue", _OWN_FMU if chosen == "fmu" else chosen, scenario.model_copy(update={"phantom": still}))
    return service.backend if isinstance(service, TissueService) else None
