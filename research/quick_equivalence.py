"""The quick tier against whole examinations of the same patients: `python -m research.quick_equivalence RUN... -o FOLDER`.

RUN is the folder of a completed whole examination. Its patient is examined by the quick tier with the constant errors of this run
(offset, tilt, place, followed breathing, start), so that both are paired; other errors are drawn. With `--drawn` all errors are
drawn, as in studies. Figures of studies are compared as the mean over cases of quick minus whole. The tiers are equivalent in a
figure when its 90 % interval lies within the margin (two one-sided t tests of 5 %).
"""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Final

import numpy as np
import typer
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy import stats

from palpate.quick.case import run_quick
from palpate.quick.errors import loop_errors
from palpate.report.evidence import map_of, read_evidence
from palpate.report.results import truth_of_run
from palpate.report.rows import Report
from palpate.report.scoring import Map
from palpate.truth.pressed import Felt, Touched
from palpate_models.numerics.frames import Array
from palpate_models.scenario.load import load_scenario
from palpate_models.scenario.schema import Scenario
from palpate_validation.check import COLOURS, QUIET, write_figure
from research.loop_errors import drawn_of, runs_in, trace_of

LEVEL: Final = 0.90
MARGINS: Final[dict[str, tuple[float, str]]] = {
    "map_bias": (0.10, "apparent stiffness of the map over the true one, mean logarithm"),
    "map_rms": (0.10, "the same, RMS of the logarithm"),
    "sensitivity": (0.10, "palpable lumps found"),
    "false_findings": (0.25, "false findings an examination"),
    "place_error_m": (0.003, "distance of findings from their lumps [m]"),
    "ratio_error": (0.10, "ratio of findings over the true one, less one"),
    "mean_force_N": (0.25, "mean measured force [N]"),
}
"""Compared figures: name, margin of the mean difference, description."""
_SHOWN: Final = 150
"""Places of a map in the plot."""


@dataclass(frozen=True, eq=False)
class Tier:
    """Result of one tier for a case."""

    figures: dict[str, float]
    """By the names of MARGINS; NaN where it has none."""
    apparent: Array
    """Apparent stiffness of the map [N], shape (n,)."""
    scanned: NDArray[np.bool_]


@dataclass(frozen=True)
class Compared:
    """The mean of quick less whole over the cases that have both."""

    name: str
    cases: int
    quick: float
    whole: float
    difference: float
    low: float
    high: float
    margin: float
    equivalent: bool


def figures_of(report: Report, found: Map, felt: Felt, touched: Touched) -> Tier:
    """Return the figures of a case."""
    true = felt.force(touched.places(found.vertices[:, :2]))
    known = found.scanned & np.isfinite(true)
    off = np.log(found.apparent[known] / true[known])
    scores = report.scores
    assert scores is not None
    palpable = scores.matched + scores.missed
    figures = {
        "map_bias": float(off.mean()),
        "map_rms": float(np.sqrt(np.mean(off**2))),
        "sensitivity": scores.matched / palpable if palpable else np.nan,
        "false_findings": float(scores.false_findings),
        "place_error_m": _or_nan(scores.place_error_m),
        "ratio_error": _or_nan(scores.ratio_error),
        "mean_force_N": _or_nan(report.mean_force_N),
    }
    return Tier(figures, found.apparent, found.scanned)


def pair(folder: Path, paired: bool) -> tuple[Scenario, Tier, Tier, float]:
    """Scenario, quick and whole tier of a run, and how long the quick simulation took [s]."""
    scenario, evidence = load_scenario(str(folder / "scenario.yaml")), read_evidence(folder)
    errors, trace = loop_errors(scenario), trace_of(folder)
    errors = errors.model_copy(update={"begin_s": trace.begin_s}) if paired else errors
    case = run_quick(scenario, errors, drawn_of(trace) if paired else None)
    known = truth_of_run(scenario, case.collected)
    assert known.felt is not None
    felt = known.felt.felt
    report = Report.model_validate_json((folder / "report.json").read_text(encoding="utf-8"))
    quick = figures_of(case.report, map_of(case.collected.stiffness_map), felt, known.felt.touched)
    whole = figures_of(report, map_of(evidence.collected.stiffness_map), felt, evidence.touched)
    return scenario, quick, whole, case.simulate_s


def compare(quick: Sequence[Tier], whole: Sequence[Tier]) -> list[Compared]:
    """Each figure over the cases, by two one-sided t tests of the paired difference."""
    rows = []
    for name, (margin, _) in MARGINS.items():
        both = np.array([(q.figures[name], w.figures[name]) for q, w in zip(quick, whole, strict=True)])
        both = both[np.isfinite(both).all(axis=1)]
        difference = both[:, 0] - both[:, 1]
        mean, count = float(difference.mean()) if len(both) else np.nan, len(both)
        varies = count > 1 and bool(difference.std() > 0)  # cases that differ by the same say nothing of others
        half = float(stats.t.ppf(0.5 + LEVEL / 2, count - 1) * stats.sem(difference)) if varies else np.inf
        low, high = mean - half, mean + half
        equivalent = bool(-margin < low and high < margin)
        q, w = (float(both[:, k].mean()) if count else np.nan for k in (0, 1))
        rows.append(Compared(name, count, q, w, mean, low, high, margin, equivalent))
    return rows


def draw(figure: Figure, quick: Sequence[Tier], whole: Sequence[Tier], rows: Sequence[Compared]) -> None:
    """Map against each other, and the differences with their intervals over their margins."""
    left, right = figure.subplots(1, 2)
    for k, (q, w) in enumerate(zip(quick, whole, strict=True)):
        both = np.flatnonzero(q.scanned & w.scanned)
        some = both[:: max(1, len(both) // _SHOWN)]
        left.loglog(w.apparent[some], q.apparent[some], ".", ms=2, color=COLOURS[k % len(COLOURS)])
    low, high = left.get_xlim()
    left.plot((low, high), (low, high), color=QUIET, lw=0.8)
    left.set(xlabel="apparent stiffness, whole [N]", ylabel="quick [N]", title=f"maps of {len(quick)} patients")
    for k, row in enumerate(rows):
        colour = COLOURS[0] if row.equivalent else COLOURS[1]
        right.plot(np.array((row.low, row.high)) / row.margin, (k, k), color=colour)
        right.plot(row.difference / row.margin, k, "o", ms=4, color=colour)
    right.axvspan(-1, 1, color=QUIET, alpha=0.15)
    right.set(yticks=range(len(rows)), yticklabels=[row.name for row in rows], xlim=(-4, 4))
    right.set(xlabel="quick less whole, over the margin; 90 % interval", title="equivalent where within the band")


def _or_nan(value: float | None) -> float:
    return np.nan if value is None else value


def main(
    runs: Annotated[list[Path], typer.Argument(help="Folders of completed whole examinations, or of many of them.")],
    drawn: Annotated[bool, typer.Option("--drawn", help="Draw all of the loop's errors, as studies do.")] = False,
    out: Annotated[Path, typer.Option("-o", "--out", help="Folder for quick.json and quick.png.")] = Path("out/quick"),
) -> None:
    """Compare the quick tier with whole examinations of the same patients."""
    quick, whole, cases = [], [], []
    for folder in runs_in(runs):
        scenario, q, w, seconds = pair(folder, not drawn)
        quick.append(q)
        whole.append(w)
        case: dict[str, Any] = {"scenario": scenario.name, "seed": scenario.seed, "quick": q.figures, "whole": w.figures}
        cases.append(case)
        words = ", ".join(f"{name} {q.figures[name]:.3g} / {w.figures[name]:.3g}" for name in MARGINS)
        print(f"{folder.name} ({seconds:.1f} s): {words}", flush=True)
    rows = compare(quick, whole)
    for row in rows:
        verdict = "equivalent" if row.equivalent else "not shown to be"
        print(
            f"{row.name:15} {row.cases:3} cases  quick {row.quick:8.4f}  whole {row.whole:8.4f}  "
            f"difference {row.difference:8.4f} ({row.low:.4f} to {row.high:.4f}), margin {row.margin:g}: {verdict}  "
            f"[{MARGINS[row.name][1]}]"
        )
    out.mkdir(parents=True, exist_ok=True)
    found = {"paired": not drawn, "compared": [asdict(row) for row in rows], "cases": cases}
    (out / "quick.json").write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    write_figure(lambda figure: draw(figure, quick, whole, rows), out / "quick.png")


if __name__ == "__main__":
    typer.run(main)
