"""The patients of the study of searches: persons who breathe, every second one with a lump of known felt contrast."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from palpate.quick.felt import FeltPatient, felt_patient
from palpate_models.numerics.frames import Array
from palpate_models.numerics.seeds import generator
from palpate_models.scenario.load import load_scenario
from palpate_models.scenario.schema import Scenario

CONTRAST: Final = 2.0
"""Felt contrast of each lump, by the surrogate, at its centre."""
RADIUS_M: Final = 0.020
BORDER_M: Final = 0.030
"""A lump's centre is at least so far inside the region."""
PRESSES: Final = 100
_MODULI: Final = (1.2, 30.0)
"""Between these the contrast of the modulus is sought."""
_ROUNDS: Final = 5


@dataclass(frozen=True)
class SearchCase:
    """One patient."""

    scenario: Scenario
    felt: FeltPatient
    """What the standard press feels of him."""
    centre: Array | None
    """Of his lump [m], shape (2,); None for a person without one."""


def case(seed: int, errors: str = "typical") -> SearchCase:
    """The patient of a seed: with a lump where the seed is odd. The modulus is such that the felt contrast is CONTRAST."""
    settings = [f"errors={errors}", "phantom.breathing.kind=quiet", "phantom.draw.lumps=[0, 0]"]
    settings += [f"exam.budget.presses={PRESSES}", "exam.budget.seconds=3600"]
    if seed % 2 == 0:
        scenario = load_scenario("person", settings, seed)
        return SearchCase(scenario, felt_patient(scenario.phantom, seed), None)
    region = load_scenario("person", settings, seed).exam
    half = 0.5 * np.array(region.region_m) - BORDER_M
    centre = generator(seed, "search lump").uniform(-half, half) + region.centre_m
    low, high = np.log(_MODULI)
    for _ in range(_ROUNDS):  # the felt contrast's logarithm is nearly straight over that of the modulus
        middle = 0.5 * (low + high)
        lump = f"{{centre_m: {centre.tolist()}, radii_m: [{RADIUS_M}, {RADIUS_M}], contrast: {np.exp(middle):.4f}}}"
        scenario = load_scenario("person", [*settings, f"phantom.lesions=[{lump}]"], seed)
        felt = felt_patient(scenario.phantom, seed)
        excess = float(felt.excess_at(centre[None])[0])
        low, high = (middle, high) if excess < np.log(CONTRAST) else (low, middle)
    return SearchCase(scenario, felt, centre)
