"""The assessment knows no mean of the population: persons whose bones are elsewhere, or whose wall is softer, get no findings."""

from collections.abc import Callable

import pytest

from palpate.quick.case import run_quick
from palpate_models.patient.person import draw_person
from palpate_models.patient.schema import Phantom
from palpate_models.scenario.load import load_scenario

PERSONS = range(600, 606)
MOST_FINDINGS = 1
"""Persons with a finding, of six; 6 % are allowed in a population."""
Change = Callable[[Phantom], Phantom]


def moved_bones(ribs_m: float, lateral_m: float, up_m: float) -> Change:
    """Return the change that moves the costal arch up, and the iliac crests outwards and up."""

    def move(person: Phantom) -> Phantom:
        assert person.anatomy is not None
        skeleton = person.anatomy.skeleton
        lateral, up = skeleton.iliac_crest_m
        bones = {"costal_arch_m": skeleton.costal_arch_m + ribs_m, "iliac_crest_m": (lateral + lateral_m, up + up_m)}
        return person.model_copy(
            update={"anatomy": person.anatomy.model_copy(update={"skeleton": skeleton.model_copy(update=bones)})}
        )

    return move


def scaled_wall(factor: float) -> Change:
    """Return the change that scales the stiffness of the wall."""
    return lambda person: person.model_copy(
        update={"stiffness": person.stiffness.model_copy(update={"k_w_n_per_m3": factor * person.stiffness.k_w_n_per_m3})}
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    "change",
    [
        moved_bones(-0.025, 0.0, 0.0),
        moved_bones(0.025, 0.0, 0.0),
        moved_bones(0.0, -0.025, 0.0),
        moved_bones(0.0, 0.025, 0.0),
        moved_bones(0.0, 0.0, 0.025),
        moved_bones(0.0, 0.0, -0.025),
        scaled_wall(0.7),
        scaled_wall(1.4),
    ],
    ids=["ribs lower", "ribs higher", "spines inwards", "spines outwards", "spines up", "spines down", "softer", "stiffer"],
)
def test_healthy_persons_of_another_mean_have_no_more_findings(change: Change) -> None:
    findings = 0
    for seed in PERSONS:
        scenario = load_scenario("person", ["errors=typical"], seed)
        person = scenario.model_copy(update={"phantom": change(draw_person(scenario.phantom, seed))})
        findings += bool(run_quick(person).report.findings)
    assert findings <= MOST_FINDINGS
