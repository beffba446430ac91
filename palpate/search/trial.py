"""One search of one patient by one policy, and the population of such patients."""

from time import perf_counter
from typing import Final, NamedTuple

import numpy as np

from palpate.quick.felt import FeltPatient, felt_patient
from palpate.search.hand import Hand
from palpate_models.numerics.frames import Array, apply
from palpate_models.numerics.seeds import generator
from palpate_models.scenario.errors import draw_errors
from palpate_models.scenario.load import load_scenario
from palpate_models.scenario.schema import Scenario
from palpate_search.posterior import Policy, Posterior


class TrialLump(NamedTuple):
    """The lump and the budget of a trial."""

    contrast: float = 2.0
    """Felt contrast of each lump, by the surrogate, at its centre."""
    radius_m: float = 0.020
    border_m: float = 0.030
    """Minimum distance of a lump's centre from the region's edge."""
    presses: int = 100


TRIAL: Final = TrialLump()
_MODULI: Final = (1.2, 30.0)
"""Search interval of the modulus contrast."""


class SearchCase(NamedTuple):
    """A patient of the search population."""

    scenario: Scenario
    felt: FeltPatient
    """Apparent stiffness by the standard press."""
    centre: Array | None
    """Centre of the lump in the abdomen frame as registered [m], shape (2,); None without one."""


def case(seed: int, errors: str = "typical") -> SearchCase:
    """Return the patient of a seed: odd seeds have a lump, whose modulus gives the felt contrast `TRIAL.contrast`."""
    settings = [f"errors={errors}", "phantom.breathing.kind=quiet", "phantom.draw.lumps=[0, 0]"]
    settings += [f"exam.budget.presses={TRIAL.presses}", "exam.budget.seconds=3600"]
    if seed % 2 == 0:
        scenario = load_scenario("person", settings, seed)
        return SearchCase(scenario, felt_patient(scenario.phantom, seed), None)
    region = load_scenario("person", settings, seed).exam
    half = 0.5 * np.array(region.region_m) - TRIAL.border_m
    centre = generator(seed, "search lump").uniform(-half, half) + region.centre_m
    low, high = np.log(_MODULI)
    for _ in range(5):  # log felt contrast is nearly linear in log modulus
        middle = 0.5 * (low + high)
        lump = f"{{centre_m: {centre.tolist()}, radii_m: [{TRIAL.radius_m}, {TRIAL.radius_m}], contrast: {np.exp(middle):.4f}}}"
        scenario = load_scenario("person", [*settings, f"phantom.lesions=[{lump}]"], seed)
        felt = felt_patient(scenario.phantom, seed)
        excess = float(felt.excess_at(centre[None])[0])
        low, high = (middle, high) if excess < np.log(TRIAL.contrast) else (low, middle)
    registered = apply(draw_errors(scenario.errors, seed).X_AAt, felt.skin_at(centre))
    return SearchCase(scenario, felt, registered[:2])


class Trial(NamedTuple):
    """A search of n presses."""

    xy: Array
    """Places of the presses [m], shape (n, 2)."""
    depth: Array
    """[m], shape (n,)"""
    force: Array
    """[N], shape (n,)"""
    seconds: Array
    """Time from the start to the end of each press [s], shape (n,)."""
    near: Array
    """Probability of a lump near the most probable place after each press, shape (n,)."""
    lump: Array
    """Probability of any lump after each press, shape (n,)."""
    place: Array
    """The most probable place [m], shape (n, 2)."""
    computing_s: float
    """Mean computing time of policy and posterior per press [s]."""

    def decided(self, threshold: float) -> int | None:
        """Return the index of the first press after which `near` reaches `threshold`; None if it never does."""
        above = np.flatnonzero(self.near >= threshold)
        return int(above[0]) if len(above) else None


def search(hand: Hand, policy: Policy, presses: int | None = None, posterior: Posterior | None = None) -> Trial:
    """Run a policy on a patient until the budget is spent, or for `presses` presses.

    `posterior`: initial posterior; updated in place.
    """
    belief = posterior or Posterior(hand.task)
    rows: list[tuple[float, ...]] = []
    computing_s = 0.0
    left = belief.remaining(hand.spent)
    count = hand.task.budget.presses if presses is None else presses
    while len(rows) < count and left.presses > 0 and left.seconds > 0:
        begin = perf_counter()
        xy, depth = policy(belief, left)
        chosen = perf_counter()
        felt = hand.press(np.asarray(xy, dtype=float), float(depth))
        pressed = perf_counter()
        belief.add(felt)
        place, near = belief.at
        computing_s += perf_counter() - pressed + chosen - begin
        rows.append((*felt.xy, felt.depth, felt.force, hand.spent, near, belief.lump, *place))
        left = belief.remaining(hand.spent)
    table = np.array(rows).reshape(-1, 9)
    depths, forces, seconds, nears, lumps = table[:, 2:7].T
    return Trial(table[:, :2], depths, forces, seconds, nears, lumps, table[:, 7:], computing_s / max(len(rows), 1))
