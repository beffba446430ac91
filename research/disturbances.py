"""Effect of one disturbance at a time on the assessment: healthy patients, scanned without physics in time.

    OPENBLAS_NUM_THREADS=1 python -m research.disturbances --patients 30 --first-seed 1000

Patients and scans are those of `felt_scans`. By default errors are the typical ones of a scan; the disturbance of a row is
unknown to the assessment. Prints a Markdown table: healthy patients with a finding, with Wilson's 95 % interval, and the
share of the area on which the map's 90 % band holds, mean and tenth percentile over patients.
"""

import argparse
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from scipy.stats import binomtest

from palpate.quick.felt import HALF_M, PITCH_M, FeltPatient, felt_patient
from palpate_assessment.assess import MapGrid, assess
from palpate_assessment.sampling import ForceSample
from palpate_models.numerics.frames import Array
from palpate_models.patient.schema import Background, Build, Phantom, Stiffness
from research.felt_scans import ScanErrors, felt_samples

TYPICAL: Final = ScanErrors(stroke_m=7e-4, field_m=5e-4, breathing_m=7e-4, tare_n=0.05)
"""Errors of the assessment's calibration."""
CLEAN: Final = ScanErrors()
DEFAULT: Final = Phantom()
REGION_M: Final = 0.2
"""Side of the square that is scanned, as in an examination."""
REACH_M: Final = 0.010
"""Within which a sample speaks for a place."""
FALSE_FINDINGS: Final = 0.02
"""The operating point."""
BAND_M: Final = 0.035
"""Distance of a rectus muscle's middle from the linea alba, and about half its width."""
BAND_RATIO: Final = 1.5
"""Stiffness ratio of the band."""

Change = Callable[[ForceSample, float], ForceSample]
"""Change of a sample; the second argument, 1 or -1, is the sign of the patient's disturbance."""


@dataclass(frozen=True)
class Disturbance:
    """One disturbance."""

    name: str
    phantom: Phantom = DEFAULT
    errors: ScanErrors = TYPICAL
    change: Change | None = None
    rectus: bool = False
    """True if the rectus muscles are two stiff bands."""


def _deeper(sample: ForceSample, sign: float) -> ForceSample:
    return sample._replace(depth=sample.depth + 0.001 * sign)


def _harder(sample: ForceSample, sign: float) -> ForceSample:
    return sample._replace(force=sample.force + 0.3 * sign)


def _drifting(sample: ForceSample, sign: float) -> ForceSample:
    return sample._replace(force=sample.force + 0.3 * sign * sample.time / 60)


def _lengthen(length_m: float) -> Phantom:
    return Phantom(stiffness=Stiffness(length_m=length_m))


ROWS: Final = (
    Disturbance("default patients"),
    Disturbance("persons", Phantom(kind="person")),
    Disturbance("slim persons", Phantom(kind="person", build=Build.SLIM)),
    Disturbance("obese persons", Phantom(kind="person", build=Build.OBESE)),
    Disturbance("wall length 10 mm", _lengthen(0.010)),
    Disturbance("wall length 20 mm", _lengthen(0.020)),
    Disturbance("background of 17.5 mm, cv 0.3", Phantom(background=Background(cv=0.3, correlation_m=0.0175))),
    Disturbance("two stiff rectus bands", rectus=True),
    Disturbance("no errors", errors=CLEAN),
    Disturbance("smooth surface error of 0.5 mm alone", errors=replace(CLEAN, field_m=5e-4)),
    Disturbance("depth off by 1 mm", change=_deeper),
    Disturbance("tare off by 0.3 N", change=_harder),
    Disturbance("drift of 0.3 N a minute", change=_drifting),
)


def examined(row: Disturbance, seed: int, region: float = REGION_M) -> tuple[int, float]:
    """Findings in the patient of a seed, and the part of a square of side `region` [m] on which the band holds."""
    patient = felt_patient(row.phantom, seed)
    if row.rectus:
        patient = _with_rectus(patient)
    samples = felt_samples(patient, row.errors, seed, region=region)
    if row.change is not None:
        sign = 1.0 if seed % 2 else -1.0
        samples = [row.change(sample, sign) for sample in samples]
    axis = np.arange(-region / 2, region / 2 + 1e-9, 0.005)
    flat = np.zeros((len(axis), len(axis)))
    found = assess(samples, MapGrid(axis, axis, flat, np.full(flat.size, 0.005**2)), REACH_M, FALSE_FINDINGS)
    assert found is not None
    assessed = found.unassessed == 0
    true = patient.force_at(found.grid.nodes[:, :2])
    held = (found.lower <= true) & (true <= found.upper)
    return len(found.findings), float(held[assessed].mean())


def _with_rectus(patient: FeltPatient) -> FeltPatient:
    """Two bands along the body on which everything is BAND_RATIO times as stiff, with edges of 10 mm."""
    x = np.arange(len(patient.force)) * PITCH_M - HALF_M
    beyond = np.abs(np.abs(x) - BAND_M) - 0.8 * BAND_M
    band: Array = BAND_RATIO ** (1 / (1 + np.exp(beyond / 0.0025)))
    return patient._replace(force=patient.force * band, healthy=patient.healthy * band)


def line(row: Disturbance, seeds: range, region: float = REGION_M) -> str:
    """Return a row of the table."""
    results = [examined(row, seed, region) for seed in seeds]
    ill = sum(findings > 0 for findings, _ in results)
    held = 100 * np.array([part for _, part in results])
    interval = binomtest(ill, len(results)).proportion_ci(method="wilson")
    rate = f"{ill} of {len(results)} ({100 * interval.low:.0f}–{100 * interval.high:.0f} %)"
    return f"| {row.name} | {rate} | {held.mean():.0f} | {np.quantile(held, 0.1):.0f} |"


def main() -> None:
    """Print the table, row by row."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--patients", type=int, default=30)
    parser.add_argument("--first-seed", type=int, default=1000)
    parser.add_argument("--region", type=float, default=REGION_M, help="side of the square that is scanned [m]")
    args = parser.parse_args()
    print("| healthy patients | with a finding | band holds [%] | tenth [%] |\n|---|---|---|---|")
    for row in ROWS:
        print(line(row, range(args.first_seed, args.first_seed + args.patients), args.region), flush=True)


if __name__ == "__main__":
    main()
