"""Checks of a scenario before an examination starts: its phantom, its scan on the true body, its services."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from palpate.run.outlook import scan_safely
from palpate.run.roles import NONE, checked, settings_of
from palpate.truth.surface import TrueBody, TrueSurface
from palpate_errors import UserError
from palpate_models.patient.mesh_file import MeshError
from palpate_models.patient.phantom import PhantomModel, build_phantom
from palpate_models.scenario.load import load_scenario
from palpate_models.scenario.patterns import Scan
from palpate_models.scenario.schema import Scenario
from palpate_plugins import PluginError, is_file


def surface_of(phantom: PhantomModel) -> TrueSurface:
    """Return the front of a body at rest, in its own frame A."""
    return TrueSurface(TrueBody(phantom.vertices, phantom.triangles, np.eye(4)))


def scan_over(scenario: Scenario, phantom: PhantomModel) -> Scan:
    """Return the scan of the scenario's pattern. Raises PluginError for an unusable pattern or a region off the body."""
    surface = surface_of(phantom)
    scan = scan_safely(scenario.exam, surface.points)
    off = ~np.isfinite(surface.height(scan.targets))
    if off.any():
        exam = scenario.exam
        (left, feet), (right, head) = (edge(phantom.vertices[:, :2], axis=0) for edge in (np.min, np.max))
        x, y = scan.targets[off][0]
        raise PluginError(
            f"{scenario.name}: exam.region_m = {exam.region_m}, exam.centre_m = {exam.centre_m}: {off.sum()} of {len(off)} "
            f"targets lie off the body, the first at ({x:.3f}, {y:.3f}) m; the body reaches from x = {left:.2f} to {right:.2f} m "
            f"and from y = {feet:.2f} to {head:.2f} m"
        )
    return scan


def with_whole_path(scenario: Scenario) -> Scenario:
    """Return the scenario with an absolute path of its pattern file: services have other working directories."""
    pattern = scenario.exam.pattern
    if not is_file(pattern):
        return scenario
    exam = scenario.exam.model_copy(update={"pattern": str(Path(pattern).resolve())})
    return scenario.model_copy(update={"exam": exam})


def usable(
    name: str,
    settings: Sequence[str] | None = None,
    seed: int | None = None,
    services: Sequence[str] | None = None,
    elsewhere: bool = False,
) -> Scenario:
    """Return a scenario whose phantom can be made and whose services exist. Raises UserError for any other.

    `services`: choices ROLE=NAME_OR_FILE. With `elsewhere` the services run in containers or on other machines and are not
    checked here.
    """
    try:
        return examinable(load_scenario(name, [*(settings or ()), *settings_of(services or ())], seed), elsewhere)
    except MeshError as error:
        raise UserError(f"{name}: {error}") from error


def examinable(scenario: Scenario, elsewhere: bool = False) -> Scenario:
    """Return the scenario after its phantom, its scan and, unless they run `elsewhere`, its services were checked.

    Raises MeshError for the phantom, PluginError for a scan that leaves the body and for a missing service.
    """
    scenario = with_whole_path(scenario)
    if scenario.services.tissue != NONE:
        scan_over(scenario, build_phantom(scenario.phantom, scenario.seed))
    return scenario if elsewhere else checked(scenario)
