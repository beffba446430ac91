"""Fits the probabilities of the assessment's candidates to tuning patients, and its operating point to healthy ones.

    python -m palpate_validation.assessment_calibration --patients 1000      writes calibration.yaml anew
    python -m palpate_validation.assessment_calibration --patients 400 --first-seed 2000 --check

Every second patient is healthy, the others have one lump; persons and scans are those of `felt_scans`. What the regression
needs of contact mechanics (exponent, conversion, lead) stays as it is: it is measured where a sphere slides over the tissue, and
a press is made beside it.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import yaml
from scipy.optimize import minimize
from scipy.special import expit

import palpate_assessment
from palpate.quick.felt import FeltPatient, felt_patient
from palpate_assessment.calibration import Calibration, learned
from palpate_assessment.detection import FEATURES, FELT, detect
from palpate_assessment.observations import observe
from palpate_models.draw import Draw
from palpate_models.frames import Array
from palpate_models.patient import Phantom
from palpate_models.seeds import generator
from palpate_validation.felt_scans import ScanErrors, felt_samples

_TAIL: Final = 0.25
"""Part of the healthy examinations that the tail is fitted to."""
_RIDGE: Final = 0.5


@dataclass(frozen=True)
class WeighedPatient:
    """What was weighed in one patient."""

    seed: int
    features: Array
    """Features of the candidates, shape (k, f)."""
    real: Array
    """Whether each is a lump of felt contrast FELT or more, shape (k,)."""
    contrast: float
    """Greatest felt contrast of the patient's lump (its inverse if softer), 1 without one."""
    held: float
    """Part of the examined region on which the map's 90 % band holds."""


def phantom(seed: int) -> Phantom:
    """Even seeds are healthy; every second of the others has a lump just below the skin, which is felt more."""
    if seed % 2 == 0:
        return Phantom(kind="person")
    contrast = (0.2, 0.6) if seed % 10 == 9 else (1.5, 8.0)
    depth = (0.0, 0.004) if seed % 4 == 1 else (0.0, 0.015)
    draw = Draw(lumps=(1, 1), radius_m=(0.010, 0.035), depth_m=depth, contrast=contrast, region_m=(0.17, 0.17))
    return Phantom(kind="person", draw=draw)


def scan_errors(seed: int) -> ScanErrors:
    """From a third of the typical errors to one and a half times as much."""
    scale = float(np.exp(generator(seed, "scan-errors").uniform(np.log(0.33), np.log(1.5))))
    return ScanErrors(stroke_m=3e-4 * scale, field_m=8e-4 * scale, breathing_m=5e-4 * scale, tare_n=0.05 * scale)


def case(seed: int, calibration: Calibration) -> WeighedPatient:
    """One patient, scanned and weighed."""
    patient = felt_patient(phantom(seed), seed)
    observations = observe(felt_samples(patient, scan_errors(seed), seed), calibration)
    assert observations is not None
    regression, candidates = detect(observations, calibration)
    axis = np.arange(-0.095, 0.0951, 0.01)
    places = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    mean, sd = regression.field(places)
    held = np.abs(mean - np.log(patient.force_at(places))) <= 1.6449 * sd
    real = [_real(patient, c.bump.x, c.bump.y, c.bump.radius, np.sign(c.log_contrast)) for c in candidates]
    greatest = float(np.exp(np.abs(patient.excess_at(places)).max()))
    rows = np.array([c.features for c in candidates]).reshape(len(candidates), len(FEATURES))
    return WeighedPatient(seed, rows, np.array(real, dtype=bool), greatest, float(held.mean()))


def _real(patient: FeltPatient, x: float, y: float, radius: float, sign: float) -> bool:
    """Whether a lump is felt within a candidate's radius."""
    angle, r = np.meshgrid(np.linspace(0, 2 * np.pi, 12, endpoint=False), np.linspace(0, 1, 4))
    places = np.array((x, y)) + radius * np.column_stack(((r * np.cos(angle)).ravel(), (r * np.sin(angle)).ravel()))
    return bool((sign * patient.excess_at(np.clip(places, -0.14, 0.14))).max() >= np.log(FELT))


def fitted(cases: list[WeighedPatient], calibration: Calibration) -> Calibration:
    """The calibration with probabilities and operating point of the cases: logistic regression, and an exponential tail."""
    features = np.concatenate([c.features for c in cases if len(c.features)])
    real = np.concatenate([c.real for c in cases if len(c.features)])

    def loss(w: Array) -> float:
        logit = w[0] + features @ w[1:]
        return float(np.logaddexp(0.0, np.where(real, -logit, logit)).sum() + _RIDGE * w[1:] @ w[1:])

    weights = minimize(loss, np.zeros(features.shape[1] + 1), method="BFGS").x
    new = calibration.model_copy(update={"probability": tuple(np.round(weights, 3).tolist())})
    greatest = np.sort([float(new.logit(c.features).max()) if len(c.features) else -20.0 for c in cases if c.contrast < 1.05])
    tail = greatest[-round(_TAIL * len(greatest)) :]
    scale = max(float(tail.mean() - tail[0]), 0.1)
    location = float(tail[0]) + scale * float(np.log(_TAIL))
    return new.model_copy(update={"tail": (round(location, 3), round(scale, 3))})


def told(cases: list[WeighedPatient], calibration: Calibration, false_findings: float = 0.02) -> None:
    """Prints what the calibration makes of cases."""
    threshold = calibration.threshold(false_findings)
    logits = [calibration.logit(c.features) if len(c.features) else np.zeros(0) for c in cases]
    healthy = [(q >= threshold).any() for q, c in zip(logits, cases, strict=True) if c.contrast < 1.05]
    print(f"threshold: probability {expit(threshold):.3f}")
    print(f"healthy: {sum(healthy)} of {len(healthy)} have a finding")
    for low, high in ((1.1, 1.3), (1.3, 1.5), (1.5, 2.0), (2.0, 20.0)):
        found = [(q[c.real] >= threshold).any() for q, c in zip(logits, cases, strict=True) if low <= c.contrast < high]
        print(f"felt contrast {low} to {high}: {sum(found)} of {len(found)} found")
    every, real = np.concatenate(logits), np.concatenate([c.real for c in cases])
    probability = expit(every)
    for low, high in ((0.0, 0.1), (0.1, 0.3), (0.3, 0.7), (0.7, 0.9), (0.9, 1.01)):
        here = (probability >= low) & (probability < high)
        if here.any():
            mean, part = probability[here].mean(), real[here].mean()
            print(f"probability {low} to {high}: {here.sum()} candidates, {mean:.2f} told, {part:.2f} true")
    soft = np.concatenate([c.features[:, FEATURES.index("softer")] > 0 for c in cases])
    for name, kind in (("stiff", ~soft), ("soft", soft)):
        reported = kind & (every >= threshold)
        lumps, there = (reported & real).sum(), (kind & real).sum()
        print(f"{name}: {reported.sum()} reported, {lumps} of them lumps; {there} candidates were lumps")
    held = np.array([c.held for c in cases])
    print(f"band holds: mean {held.mean():.3f}, median {np.median(held):.3f}, tenth {np.quantile(held, 0.1):.3f}")


def main() -> None:
    """Calibrates, or checks the calibration."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--patients", type=int, default=1000)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--check", action="store_true", help="print figures of the present calibration, change nothing")
    args = parser.parse_args()
    calibration = learned()
    cases = [case(seed, calibration) for seed in range(args.first_seed, args.first_seed + args.patients)]
    if not args.check:
        calibration = fitted(cases, calibration)
        path = Path(palpate_assessment.__path__[0]) / "calibration.yaml"
        path.write_text(yaml.safe_dump(calibration.model_dump(mode="json"), sort_keys=False, default_flow_style=None), "utf-8")
    told(cases, calibration)


if __name__ == "__main__":
    main()
