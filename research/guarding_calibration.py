"""Fits how probable a tensed muscle is to tuning patients who guard, and to others who do not.

    python -m research.guarding_calibration -o FOLDER         writes the weights into calibration.yaml

The persons are those of the split tune of the studies `guarding` and, the first FIRST of each population, `operating-point`. The
logit l of a lump stays as `assessment_calibration` fitted it: given it, the weights w of the muscle's signs s are the most likely
ones of a logistic regression with three outcomes, lump, muscle, neither, of weights exp(l), exp(w . s), 1. What was weighed in
each patient is kept in FOLDER: cases that are there are not made again, and a changed assessment needs a new FOLDER.
"""

from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any, Final

import numpy as np
import typer
import yaml
from pydantic import TypeAdapter
from scipy.optimize import minimize
from sklearn.metrics import roc_auc_score

import palpate_assessment
from palpate.quick.case import assess, examine_quickly
from palpate.report.results import truth_of_run
from palpate.report.scoring import Truth
from palpate.study.cases import Case, Request, cases_of
from palpate.study.spec import load_study
from palpate_assessment.assess import weigh_all
from palpate_assessment.detection import Candidate
from palpate_assessment.service import AssessmentService
from palpate_assessment.standard import USUAL, Calibration, load_calibration, observe
from palpate_models.numerics.frames import Array
from palpate_models.scenario.load import exam_input
from palpate_models.scenario.schema import Scenario
from research.assessment_calibration import real

FIRST: Final = 50
_RIDGE: Final = 0.1


class TrueCause(StrEnum):
    """True cause of a candidate."""

    LUMP = "lump"
    MUSCLE = "muscle"
    NEITHER = "neither"


@dataclass(frozen=True)
class Weighed:
    """A candidate."""

    logit: float
    """Logit of a lump by the present calibration."""
    signs: list[float]
    """Signs of a muscle."""
    softer: bool
    cause: TrueCause


def cases() -> list[Case]:
    """Return the tuning patients."""
    found = cases_of(load_study("guarding"), Request(split="tune"))
    others = cases_of(load_study("operating-point"), Request(split="tune"))
    return [*found, *(case for case in others if case.number < FIRST)]


def weigh(case: Case) -> list[Weighed]:
    """The candidates of one patient's examination, and what they truly are."""
    scenario = Scenario.model_validate(case.scenario)
    gathered = examine_quickly(scenario)
    known = truth_of_run(scenario, gathered).felt
    gathered.exam_states = gathered.exam_states[:-1]  # the last asks for findings
    service = AssessmentService(exam_input(scenario))
    assess(service, gathered)
    calibration = load_calibration()
    observations = observe(service.samples, USUAL)
    judged = None if observations is None else weigh_all(observations)
    assert known is not None
    assert judged is not None
    _, candidates, _ = judged
    logits: Array = calibration.logit(np.array([c.features for c in candidates])) if candidates else np.zeros(0)
    return [
        Weighed(float(logit), list(c.signs), c.log_contrast < 0, cause(c, known))
        for c, logit in zip(candidates, logits, strict=True)
    ]


def cause(candidate: Candidate, known: Truth) -> TrueCause:
    """Return the true cause of a candidate; a muscle only where it is stiffer."""
    if real(candidate, known):
        return TrueCause.LUMP
    middle = known.touched.places(np.array([[candidate.bump.x, candidate.bump.y]]))
    guarded = candidate.log_contrast > 0 and known.felt.inside(known.felt.guarded, middle)[0]
    return TrueCause.MUSCLE if guarded else TrueCause.NEITHER


def fitted(rows: list[Weighed]) -> Array:
    """Weights of the signs, the constant first, shape (3,)."""
    signs, lump = np.array([row.signs for row in rows]), np.array([row.logit for row in rows])
    softer, chosen = np.array([row.softer for row in rows]), np.array([list(TrueCause).index(row.cause) for row in rows])

    def loss(w: Array) -> float:
        muscle = np.where(softer, -np.inf, w[0] + signs @ w[1:])
        logits = np.stack((lump, muscle, np.zeros(len(rows))))
        true_logit = np.take_along_axis(logits, chosen[np.newaxis], axis=0)[0]
        return float((np.logaddexp.reduce(logits, axis=0) - true_logit).sum() + _RIDGE * w[1:] @ w[1:])

    return np.asarray(minimize(loss, np.zeros(3), method="BFGS").x)


def evaluate(rows: list[Weighed], calibration: Calibration, false_findings: float = 0.02) -> None:
    """Print what the weights change among the patients that they are fitted to."""
    muscle = calibration.muscle(np.array([row.signs for row in rows]))
    muscle[[row.softer for row in rows]] = -np.inf
    before = np.array([row.logit for row in rows])
    now, threshold = before - np.logaddexp(0, muscle), calibration.threshold(false_findings)
    for one in TrueCause:
        here = np.array([row.cause is one for row in rows])
        reported = [int((logits[here] >= threshold).sum()) for logits in (before, now)]
        print(f"{one}: {here.sum()} candidates, {reported[0]} reported before, {reported[1]} now")
    lump, tensed = (np.array([row.cause is one for row in rows]) for one in (TrueCause.LUMP, TrueCause.MUSCLE))
    either = lump | tensed
    print(
        f"muscle against lump: AUC {roc_auc_score(tensed[either], (muscle - before)[either].clip(-50, 50)):.2f} of {either.sum()}"
    )


def kept(case: Case, folder: Path) -> list[Weighed]:
    """Return the candidates of a patient, from the folder if present."""
    path, kind = folder / f"{case.case_id}.json", TypeAdapter(list[Weighed])
    if not path.is_file():
        path.write_bytes(kind.dump_json(weigh(case)))
    return kind.validate_json(path.read_bytes())


def main(
    out: Annotated[Path, typer.Option("-o", "--out", help="Where cases are kept.")] = Path("out/guarding-calibration"),
) -> None:
    """Fit the probability of a tensed muscle, and write it to calibration.yaml."""
    out.mkdir(parents=True, exist_ok=True)
    rows = [row for case in cases() for row in kept(case, out)]
    new: dict[str, Any] = load_calibration().model_dump(mode="json") | {"guarding": np.round(fitted(rows), 2).tolist()}
    path = Path(palpate_assessment.__path__[0]) / "calibration.yaml"
    path.write_text(yaml.safe_dump(new, sort_keys=False, default_flow_style=None), "utf-8")
    evaluate(rows, Calibration.model_validate(new))


if __name__ == "__main__":
    typer.run(main)
