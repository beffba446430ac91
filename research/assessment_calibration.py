"""Fits the probabilities of the assessment's candidates to tuning patients, and its operating point to healthy ones.

    python -m research.assessment_calibration --patients 600 --more-healthy 100 -o FOLDER
    python -m research.assessment_calibration --patients 100 --first-seed 2000 --check -o FOLDER

The first command writes calibration.yaml, the second evaluates the calibration on other patients.

Persons are examined by the quick tier with typical errors and quiet breathing; every second one is healthy, the others have
one lump. The candidates of each are kept in FOLDER, so an interrupted calibration continues; a changed assessment needs a
new FOLDER. The parameters of contact mechanics (exponent, conversion, lead) are kept: they are measured by slides and
presses on the tissue.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Final

import numpy as np
import typer
import yaml
from numpy.typing import NDArray
from pydantic import TypeAdapter
from scipy.optimize import minimize
from scipy.special import expit
from statsmodels.api import Logit
from statsmodels.stats.proportion import proportion_confint

import palpate_assessment
from palpate.quick.case import assess, examine_quickly
from palpate.report.results import truth_of_run
from palpate.report.scoring import Truth
from palpate.study.statistics.estimate import LEVEL, Estimate
from palpate.truth.pressed import PALPABLE
from palpate_assessment.assess import causes, weigh_all
from palpate_assessment.detection import FEATURES, FELT, STRUCTURES, SURE, Candidate
from palpate_assessment.service import AssessmentService
from palpate_assessment.standard import USUAL, Calibration, load_calibration, observe
from palpate_models.numerics.frames import Array
from palpate_models.scenario.load import exam_input, load_scenario
from palpate_models.scenario.schema import Scenario

Mask = NDArray[np.bool_]

_TAIL: Final = 0.25
"""Part of the healthy examinations that the tail is fitted to."""
_RIDGE: Final = 0.1
NONE: Final = -20.0
"""Logit of a patient in whom nothing was weighed."""
CLASSES: Final = ((1.05, 1.3), (1.3, 1.5), (1.5, 2.0), (2.0, 20.0))
"""Classes of felt contrast."""
WIDE_M: Final = 0.015
"""Minimum felt radius of a separate class [m]."""


@dataclass(frozen=True)
class WeighedPatient:
    """Candidates of one patient."""

    seed: int
    features: list[list[float]]
    """Features of the candidates that are weighed."""
    signs: list[list[float]]
    """Signs of muscles about them."""
    structures: list[list[float]]
    """Evidence for structures instead."""
    real: list[bool]
    """True where a candidate is a lump of felt contrast FELT or more."""
    contrast: float
    """Felt contrast of the patient's lump (its inverse if softer), 1 without one that is palpable."""
    radius_m: float
    """Its felt radius, 0 without one."""


def scenario(seed: int) -> Scenario:
    """Even seeds are healthy; every second of the others has a lump just below the skin, which is felt more."""
    settings = ["errors=typical", "phantom.breathing.kind=quiet"]
    if seed % 2:
        contrast = (0.2, 0.6) if seed % 10 == 9 else (1.5, 8.0)
        depth = (0.0, 0.004) if seed % 4 == 1 else (0.0, 0.015)
        lump = f"lumps: [1, 1], radius_m: [0.010, 0.035], depth_m: {list(depth)}, contrast: {list(contrast)}"
        settings.append(f"phantom.draw={{{lump}}}")
    return load_scenario("person", settings, seed)


def weigh(seed: int) -> WeighedPatient:
    """One patient, examined and weighed."""
    patient = scenario(seed)
    gathered = examine_quickly(patient)
    known = truth_of_run(patient, gathered).felt
    gathered.exam_states = gathered.exam_states[:-1]  # the last asks for findings
    service = AssessmentService(exam_input(patient))
    assess(service, gathered)
    observations = observe(service.samples, USUAL)
    judged = None if observations is None else weigh_all(observations)
    assert known is not None
    assert judged is not None
    candidates = [candidate for candidate in judged[1] if candidate.beyond > -SURE]
    palpable = [lump for lump in known.felt.lumps if lump.palpable]

    return WeighedPatient(
        seed=seed,
        features=[candidate.features.tolist() for candidate in candidates],
        signs=[list(candidate.signs) for candidate in candidates],
        structures=[candidate.structures().tolist() for candidate in candidates],
        real=[real(candidate, known) for candidate in candidates],
        contrast=max((float(np.exp(abs(np.log(lump.contrast)))) for lump in palpable), default=1.0),
        radius_m=max((float(np.sqrt(lump.area / np.pi)) for lump in palpable), default=0.0),
    )


def real(candidate: Candidate, known: Truth) -> bool:
    """Return True if a lump of felt contrast FELT or more is within a candidate's disc."""
    bump, sign = candidate.disc, np.sign(candidate.log_contrast)
    angle, r = np.meshgrid(np.linspace(0, 2 * np.pi, 12, endpoint=False), np.linspace(0, 1, 4))
    ring = np.column_stack(((r * np.cos(angle)).ravel(), (r * np.sin(angle)).ravel()))
    there = known.touched.places(np.array((bump.x, bump.y)) + bump.radius * ring)
    return bool(np.nan_to_num(sign * known.felt.excess(there)).max() >= np.log(FELT))


def fitted(cases: list[WeighedPatient], calibration: Calibration) -> Calibration:
    """Return the calibration with probabilities and operating point of the cases: logistic regression, and an exponential tail.

    The regression is of a lump against all else, the tail of what is reported, with muscles among what else it may be.
    """
    features, real = _every(cases)

    def loss(w: Array) -> float:
        logit = w[0] + features @ w[1:]
        return float(np.logaddexp(0.0, np.where(real, -logit, logit)).sum() + _RIDGE * w[1:] @ w[1:])

    weights = minimize(loss, np.zeros(features.shape[1] + 1), method="BFGS").x
    new = calibration.model_copy(update={"probability": tuple(np.round(weights, 3).tolist())})
    highest = np.sort([reported(c, new).max(initial=NONE) for c in cases if c.contrast < 1 + PALPABLE])
    tail = highest[-round(_TAIL * len(highest)) :]
    scale = max(float(tail.mean() - tail[0]), 0.1)
    location = float(tail[0]) + scale * float(np.log(_TAIL))
    return new.model_copy(update={"tail": (round(location, 3), round(scale, 3))})


def _every(cases: list[WeighedPatient]) -> tuple[Array, Mask]:
    """Features (k, f) of all candidates, and whether each is a lump (k,)."""
    rows = np.array([row for c in cases for row in c.features]).reshape(-1, len(FEATURES))
    return rows, np.array([r for c in cases for r in c.real], dtype=bool)


def reported(case: WeighedPatient, calibration: Calibration) -> Array:
    """Logits of the probabilities that the assessment reports of a patient's candidates, shape (k,)."""
    rows = zip((case.features, case.signs, case.structures), (len(FEATURES), 2, STRUCTURES), strict=True)
    features, signs, evidence = (np.array(values).reshape(-1, width) for values, width in rows)
    return causes(calibration, features, signs, evidence)[0]


def evaluate(cases: list[WeighedPatient], calibration: Calibration, false_findings: float = 0.02) -> None:
    """Print the performance of the calibration on cases, with 95 % intervals."""
    threshold = calibration.threshold(false_findings)
    logits = [reported(c, calibration) for c in cases]
    print(f"{len(cases)} patients, seeds {cases[0].seed} to {cases[-1].seed}; threshold: probability {expit(threshold):.3f}")
    healthy = [bool((q >= threshold).any()) for q, c in zip(logits, cases, strict=True) if c.contrast < 1 + PALPABLE]
    print(f"healthy with a finding: {_part(healthy)}")
    for low, high in CLASSES:
        for name, min_radius in (("", 0.0), (f", felt radius {1e3 * WIDE_M:.0f} mm or more", WIDE_M)):
            found = [
                bool((q[np.array(c.real, dtype=bool)] >= threshold).any())
                for q, c in zip(logits, cases, strict=True)
                if low <= c.contrast < high and c.radius_m >= min_radius
            ]
            print(f"felt contrast {low} to {high}{name}: found {_part(found)}")
    every, real = np.concatenate(logits), _every(cases)[1]
    probability = expit(every)
    error = 0.0
    for low, high in ((0.0, 0.1), (0.1, 0.3), (0.3, 0.7), (0.7, 0.9), (0.9, 1.01)):
        here = (probability >= low) & (probability < high)
        if here.any():
            mean, part = float(probability[here].mean()), float(real[here].mean())
            error += here.mean() * abs(mean - part)
            print(f"probability {low} to {high}: {here.sum()} candidates, {100 * mean:.0f} % predicted, {_part(real[here])} true")
    fit = ", ".join(f"{name} {e.value:.2f} ({e.low:.2f} to {e.high:.2f})" for name, e in slope(every, real).items())
    print(f"expected calibration error {100 * error:.1f} %; calibration {fit}")


def _part(true: Iterable[bool]) -> str:
    """Return number and share, with Wilson's interval."""
    rows = list(true)
    if not rows:
        return "0 of 0"
    low, high = proportion_confint(sum(rows), len(rows), alpha=1 - LEVEL, method="wilson")
    return f"{sum(rows)} of {len(rows)}: {100 * np.mean(rows):.1f} % ({100 * low:.1f} to {100 * high:.1f})"


def slope(logits: Array, real: Mask) -> dict[str, Estimate]:
    """Slope and intercept of a logistic regression of real lumps on the predicted logits (Cox 1958), with 95 % intervals.

    For perfect calibration they are 1 and 0.
    """
    found = Logit(real.astype(float), np.column_stack((np.ones(len(logits)), logits))).fit(disp=False)
    ends = found.conf_int(alpha=1 - LEVEL)
    return {
        name: Estimate(
            value=float(found.params[k]),
            low=float(ends[k, 0]),
            high=float(ends[k, 1]),
            n=len(real),
            of="candidates",
            interval="Wald",
        )
        for k, name in ((1, "slope"), (0, "intercept"))
    }


def kept(seed: int, folder: Path) -> WeighedPatient:
    """Return the candidates of a patient, from the folder if present."""
    path = folder / f"{seed}.json"
    kind = TypeAdapter(WeighedPatient)
    if not path.is_file():
        path.write_bytes(kind.dump_json(weigh(seed)))
    return kind.validate_json(path.read_bytes())


def main(
    patients: Annotated[int, typer.Option(min=10, help="How many persons.")] = 200,
    first_seed: Annotated[int, typer.Option(help="Seed of the first.")] = 0,
    more_healthy: Annotated[int, typer.Option(min=0, help="How many healthy ones more, with the even seeds that follow.")] = 0,
    check: Annotated[bool, typer.Option("--check", help="Print figures of the present calibration, change nothing.")] = False,
    out: Annotated[Path, typer.Option("-o", "--out", help="Where cases are kept.")] = Path("out/calibration"),
) -> None:
    """Calibrate, or check the calibration."""
    out.mkdir(parents=True, exist_ok=True)
    beyond = first_seed + patients
    next_even = beyond + beyond % 2
    seeds = [*range(first_seed, beyond), *range(next_even, next_even + 2 * more_healthy, 2)]
    cases = [kept(seed, out) for seed in seeds]
    calibration = load_calibration()
    if not check:
        calibration = fitted(cases, calibration)
        path = Path(palpate_assessment.__path__[0]) / "calibration.yaml"
        path.write_text(yaml.safe_dump(calibration.model_dump(mode="json"), sort_keys=False, default_flow_style=None), "utf-8")
    evaluate(cases, calibration)


if __name__ == "__main__":
    typer.run(main)
