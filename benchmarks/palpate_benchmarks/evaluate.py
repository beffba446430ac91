"""`palpate evaluate`: how well examinations find what is there, over scenarios and seeds, with the same code and thresholds.

`elsewhere` stands for lesions that no scenario has: one a seed, place, size and contrast drawn from it.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

ELSEWHERE = "elsewhere"
DEFAULT_CASES = ("lump", "healthy", "two_lesions", ELSEWHERE)


@dataclass(frozen=True)
class Evaluation:
    """One examination."""

    name: str
    seed: int
    settings: tuple[str, ...] = ()
    """Overrides `a.b=c` of the scenario."""

    @property
    def words(self) -> list[str]:
        """The words of its `palpate run`."""
        settings = [word for setting in self.settings for word in ("--set", setting)]
        if self.name != ELSEWHERE:
            return [self.name, *settings]
        rng = np.random.default_rng([self.seed, 20])
        x, y = rng.uniform(-0.06, 0.06, 2)
        a, b = rng.uniform(0.020, 0.035, 2)
        contrast = rng.uniform(2.5, 6.0)
        lesion = f"{{centre_m: [{x:.4f}, {y:.4f}], radii_m: [{a:.4f}, {b:.4f}], contrast: {contrast:.2f}}}"
        return ["healthy", "--set", f"phantom.lesions=[{lesion}]", "--set", f"name={ELSEWHERE}", *settings]


def run_case(case: Evaluation) -> dict[str, Any]:
    """Its report; of a run that did not complete its scenario, seed and `failure` alone."""
    with tempfile.TemporaryDirectory(prefix="palpate-evaluate-") as folder:
        options = ["--composed", "--no-record", "--quiet", "--seed", str(case.seed), "--out", folder]
        done = subprocess.run(
            [sys.executable, "-m", "palpate", "run", *case.words, *options], capture_output=True, text=True, check=False
        )
        if done.returncode:
            words = done.stderr.strip().splitlines() or [""]
            return {"scenario": case.name, "seed": case.seed, "failure": f"status {done.returncode}: {words[-1]}"}
        report: dict[str, Any] = json.loads((Path(folder) / "report.json").read_text(encoding="utf-8"))
        return report


def evaluate(
    cases: Sequence[Evaluation], workers: int, tell: Callable[[int, int, str], None] = lambda *_: None
) -> list[dict[str, Any]]:
    """The reports of all cases, `workers` at a time. `tell` hears how many of how many are done, and which was the last.

    A case that did not complete has a report with `failure`, `scenario` and `seed` alone: none is left out of the count.
    """
    tell(0, len(cases), "")
    with ThreadPoolExecutor(workers) as pool:
        running = {pool.submit(run_case, case): case for case in cases}
        for done, future in enumerate(as_completed(running), 1):
            tell(done, len(cases), f"{running[future].name}, seed {running[future].seed}")
        return [future.result() for future in running]


def table(reports: Sequence[dict[str, Any]]) -> Table:
    """One row an examination: one that failed, or whose patient cannot be pressed for the truth, has no scores."""
    rows = Table(
        "scenario", "seed", "found", "missed", "not palpable", "false", "place [mm]", "Dice", "ratio off", "band holds",
        "in lumps", "max force [N]", "depth RMS [mm]", "surface RMS [mm]", "skipped", "real time", box=None,
    )  # fmt: skip
    for report in reports:
        if report["failure"]:
            rows.add_row(report["scenario"], str(report["seed"]), "[red]failed[/]")
            continue
        scores = report["scores"]
        if scores is None:
            rows.add_row(report["scenario"], str(report["seed"]), "unknown")
            continue

        def figure(value: float | None, scale: float = 1.0, form: str = ".2f") -> str:
            return "" if value is None else format(scale * value, form)

        rows.add_row(
            report["scenario"],
            str(report["seed"]),
            str(scores["matched"]),
            str(scores["missed"]),
            str(scores["not_palpable"]),
            str(scores["false_findings"]),
            figure(scores["place_error_m"], 1e3, ".1f"),
            figure(scores["dice"]),
            figure(scores["ratio_error"]),
            figure(scores["coverage_90"]),
            figure(scores["coverage_90_in_lumps"]),
            figure(report["max_force_N"], 1.0, ".1f"),
            figure(report["depth_rms_error_m"], 1e3),
            figure(report["surface_rms_error_m"], 1e3),
            str(report["skipped_targets"]),
            f"{report['real_time_factor']:.1f} x",
        )
    return rows
