"""The tissue as an FMU against the native tissue: the same numbers over a path."""

from pathlib import Path

import numpy as np
import pytest

from palpate_fmu.compiling import native
from palpate_fmu.export import build_scenario_fmu
from palpate_fmu.instance import FmuInstance
from palpate_models.patient.motion import BreathingCurve
from palpate_models.patient.phantom import build_phantom
from palpate_models.scenario.load import load_scenario
from palpate_tissue.backends.winkler.tissue import WinklerTissue
from palpate_tissue.surface import SkinSurface

BOUND = 1e-9
"""Allowed relative difference. Both add the same terms in different orders; measured 1e-13."""
RADIUS_M = 0.015
STEP_S = 1e-3


def path(surface: SkinSurface) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Return positions and velocities of a press, a hold, a slide over the lesion, a withdrawal and a wait."""
    x = np.concatenate((np.full(800, -0.09), np.linspace(-0.09, -0.01, 1600), np.full(1000, -0.01)))
    depth = np.concatenate((np.linspace(-0.003, 0.010, 400), np.full(2400, 0.010), np.linspace(0.010, -0.05, 600)))
    under = [surface.nearest(np.array((at, -0.055, 0.0))) for at in x]
    position = np.array([one.position + (RADIUS_M - below) * one.normal for one, below in zip(under, depth, strict=True)])
    spin = np.tile((0.2, -0.1, 0.5), (len(x), 1))
    return list(zip(position, np.gradient(position, STEP_S, axis=0), spin, strict=True))


BREATHING = "phantom.breathing.kind=quiet"
FINE = "phantom.edge_m=0.0035"
STIFFENING = "phantom.stiffness.stiffening_per_m=80"
STRAIGHT_SOON = "phantom.stiffness.stiffening_per_m=600"
"""The modulus rises no further from a depth of 6.5 mm on."""
INVOLUNTARY = "phantom.guarding=[{centre_m: [-0.03, -0.04], kind: involuntary}]"
VOLUNTARY = "phantom.guarding=[{centre_m: [-0.03, -0.04], kind: voluntary}]"
PERSON = "phantom={kind: person, draw: {lumps: [2, 2]}, lesions: [{centre_m: [-0.05, -0.055], depth_m: 0.01}]}"


@pytest.mark.parametrize(
    "settings",
    [(STRAIGHT_SOON, INVOLUNTARY), (STIFFENING, VOLUNTARY, BREATHING, FINE), (PERSON, BREATHING)],
    ids=["guarding", "all", "person"],
)
def test_force_torque_and_displacement_agree_over_a_sliding_path(settings: tuple[str, ...], tmp_path: Path) -> None:
    scenario = load_scenario("clean", settings)
    model = build_phantom(scenario.phantom, scenario.seed)
    tissue = WinklerTissue(model, scenario.phantom.stiffness, BreathingCurve(scenario.phantom.breathing, scenario.seed))
    motions = path(SkinSurface(model))
    if FINE in settings:
        motions = motions[:1500]
    wrenches = np.empty((len(motions), 2, 6))
    moved = largest = 0.0
    with FmuInstance(build_scenario_fmu(scenario, tmp_path / "abdomen.fmu", 3, [native()]), -STEP_S) as fmu:
        motion = fmu.port(["indenter_position", "indenter_velocity", "indenter_angular_velocity"])
        wrench, surface = fmu.port(["contact_force", "contact_torque"]), fmu.port(["surface_displacement"])
        for k, (p, v, w) in enumerate(motions):
            wrenches[k, 0] = np.concatenate(tissue.step(k * STEP_S, p, v, RADIUS_M, w))
            motion.values[:] = (*p, *v, *w)
            motion.push()
            fmu.step((k - 1) * STEP_S, STEP_S)
            wrenches[k, 1] = wrench.pull()
            assert abs(float(fmu.get("activation")) - tissue.activation) < BOUND
            if k % 20 == 0:
                moved = max(moved, float(np.abs(surface.pull() - tissue.inward).max()))
                largest = max(largest, float(np.abs(tissue.inward).max()))
    difference = np.abs(wrenches[:, 0] - wrenches[:, 1]).max(axis=0)
    scale = np.linalg.norm(wrenches[:, 0, :3], axis=1).max()
    assert scale > 2
    assert (VOLUNTARY in settings) == (tissue.activation < 1)
    assert largest > 0.005
    assert difference[:3].max() < BOUND * scale, difference
    assert difference[3:].max() < BOUND * scale * RADIUS_M, difference
    assert moved < BOUND * largest
