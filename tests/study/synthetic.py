"""A study of seconds, and tables of studies whose truth is known."""

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.special import expit
from scipy.stats import norm

from palpate.study.spec import Study
from palpate.study.statistics.reading import Tables, tables_of

TOY: dict[str, Any] = {
    "name": "toy",
    "tier": "quick",
    "populations": {
        "clean": {"scenario": "clean", "number": {"tune": 2, "test": 3}, "settings": {"exam.region_m": [0.03, 0.03]}}
    },
}


def study(**changes: Any) -> Study:
    """Return the toy study with other fields."""
    return Study.model_validate({**TOY, **changes})


SLOPES = {"felt_contrast": 4.0, "felt_radius_m": 300.0, "depth_m": -60.0}
"""Slopes of the log odds of detection against the logarithm of felt contrast, felt radius [1/m] and depth [1/m]."""
AT = {"felt_contrast": 1.4, "felt_radius_m": 0.012, "depth_m": 0.010}
"""A lump that is found with probability 1/2, without lapses."""


def true_probability(lumps: pd.DataFrame, lapse: float = 0.0) -> NDArray[np.float64]:
    """Return the probability with which each lump is found."""
    odds = SLOPES["felt_contrast"] * np.log(lumps["felt_contrast"] / AT["felt_contrast"])
    odds += SLOPES["felt_radius_m"] * (lumps["felt_radius_m"] - AT["felt_radius_m"])
    odds += SLOPES["depth_m"] * (lumps["depth_m"] - AT["depth_m"])
    return np.asarray((1 - lapse) * expit(odds), dtype=np.float64)


def true_radius(chance: float, felt_contrast: float, depth_m: float, lapse: float = 0.0) -> float:
    """Return the felt radius [m] at which a lump is found with probability `chance`."""
    reach = chance / (1 - lapse)
    odds = np.log(reach / (1 - reach))
    odds -= SLOPES["felt_contrast"] * np.log(felt_contrast / AT["felt_contrast"]) + SLOPES["depth_m"] * (depth_m - AT["depth_m"])
    return AT["felt_radius_m"] + float(odds) / SLOPES["felt_radius_m"]


def case(number: int, population: str, **fields: Any) -> dict[str, Any]:
    """Return a row of cases.parquet."""
    method = fields.get("method", "palpate")
    return {
        "case_id": f"{population}-{number}-{method}-{fields.get('errors', 'typical')}",
        "study": "synthetic", "population": population, "method": method, "split": "test", "number": number,
        "seed": 1000 + number,
        "tier": "whole", "errors": "typical", "status": "done", "attempts": 1, "why": "", "run_hash": "0", "completed": True,
        "palpable": 0, "not_palpable": 0, "matched": 0, "missed": 0, "false_findings": 0, "score": 0.0, "coverage_area": 0.9,
        "coverage_lumps": 0.9, "coverage_ratio": np.nan, "depth_rms_m": 3e-4, "peak_force_n": 9.0, "exam_time_s": 200.0,
        "sim_time_s": 220.0, "wall_time_s": 80.0, "assess_time_s": 4.0, "loop_examinations": np.nan,
        **fields,
    }  # fmt: skip


def finding(case_id: str, confidence: float, lump: int, **fields: Any) -> dict[str, Any]:
    """Return a row of findings.parquet."""
    return {
        "case_id": case_id, "index": 0, "reported": confidence >= 0.5, "x_m": 0.0, "y_m": 0.0, "z_m": 0.0, "area_m2": 1.1e-3,
        "ratio": 1.6, "ratio_lower": 1.3, "ratio_upper": 1.9, "confidence": confidence, "lump": lump,
        "place_error_m": 4e-3 if lump >= 0 else np.nan, "area_true_m2": 1e-3 if lump >= 0 else np.nan,
        "ratio_true": 1.5 if lump >= 0 else np.nan, **fields,
    }  # fmt: skip


def lump(case_id: str, **fields: Any) -> dict[str, Any]:
    """Return a row of lumps.parquet."""
    return {
        "case_id": case_id, "lump": 0, "felt_contrast": 1.5, "felt_radius_m": 0.015, "depth_m": 0.01, "radius_m": 0.015,
        "contrast": 4.0, "palpable": True, "found": False, "confidence": 0.0, "place_error_m": np.nan, **fields,
    }  # fmt: skip


def tables(cases: list[dict[str, Any]], findings: list[dict[str, Any]], lumps: list[dict[str, Any]]) -> Tables:
    """Return tables of rows."""
    return tables_of(*frames(cases, findings, lumps))


def frames(
    cases: list[dict[str, Any]], findings: list[dict[str, Any]], lumps: list[dict[str, Any]]
) -> tuple[pd.DataFrame, pd.DataFrame, pd.DataFrame]:
    """Return rows as frames, with all columns even without a row."""
    samples = (case(0, "none"), finding("none", 0.0, -1), lump("none"))
    found = [pd.DataFrame(rows, columns=list(sample)) for rows, sample in zip((cases, findings, lumps), samples, strict=True)]
    found[1] = found[1].astype({"reported": bool, "lump": int, "confidence": float})
    found[2] = found[2].astype({"palpable": bool, "found": bool, "confidence": float})
    return found[0], found[1], found[2]


def write(folder: Path, found: tuple[pd.DataFrame, pd.DataFrame, pd.DataFrame]) -> Path:
    """Write frames as a study's folder."""
    for name, frame in zip(("cases", "findings", "lumps"), found, strict=True):
        frame.to_parquet(folder / f"{name}.parquet")
    return folder


def binormal(rng: np.random.Generator, ill: int, healthy: int, separation: float) -> tuple[Tables, float]:
    """Patients whose scores are normal, those with a lump `separation` standard deviations higher; and the true AUC."""
    cases, lumps, findings = [], [], []
    for population, count, shift in (("lumps", ill, separation), ("healthy", healthy, 0.0)):
        for number, z in enumerate(rng.normal(shift, 1, count)):
            score = float(norm.cdf(z - separation / 2))
            row = case(number, population, score=score, palpable=int(shift > 0), false_findings=int(shift == 0 and score >= 0.5))
            cases.append(row)
            findings.append(finding(row["case_id"], score, 0 if shift else -1))
            if shift:
                lumps.append(lump(row["case_id"], found=score >= 0.5, confidence=score))
    return tables(cases, findings, lumps), float(norm.cdf(separation / np.sqrt(2)))


def psychometric(rng: np.random.Generator, n: int, lapse: float = 0.0) -> Tables:
    """Patients with one lump each, found by the known psychometric function."""
    cases = [case(number, "lumps", palpable=1) for number in range(n)]
    lumps = pd.DataFrame([lump(row["case_id"]) for row in cases])
    lumps["felt_contrast"] = np.exp(rng.uniform(np.log(1.05), np.log(2.5), n))
    lumps["felt_radius_m"] = rng.uniform(0.004, 0.030, n)
    lumps["depth_m"] = rng.uniform(0.0, 0.030, n)
    lumps["radius_m"], lumps["contrast"] = lumps["felt_radius_m"], lumps["felt_contrast"]
    lumps["found"] = rng.random(n) < true_probability(lumps, lapse)
    lumps["confidence"] = lumps["found"].astype(float)
    return tables_of(pd.DataFrame(cases), frames(cases, [], [])[1], lumps)
