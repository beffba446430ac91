"""Results of the study of searches: `python -m research.search.curves out/search-study` prints the table and draws the curves.

The threshold of each policy is the SPECIFICITY quantile, over healthy tuning patients, of the highest probability within the
budget. A lump is found at the press after which it is first said to be near a place within NEAR_M of where it is; one that is
first said to be elsewhere, or never, counts as the whole budget. Intervals: Wilson's for shares, percentiles of 2,000 bootstrap
samples of patients for all else.
"""

from pathlib import Path
from typing import Annotated, Final

import numpy as np
import pandas as pd
import typer
from matplotlib.figure import Figure
from statsmodels.stats.proportion import proportion_confint

from palpate.study.cases import TUNE_SEEDS
from palpate_models.numerics.frames import Array

SPECIFICITY: Final = 0.95
NEAR_M: Final = 0.020
OURS: Final = "informed"
_BOOTSTRAPS: Final = 2000


def thresholds(trials: pd.DataFrame) -> pd.Series:
    """Return the threshold of each policy."""
    healthy = trials[(trials.seed < TUNE_SEEDS) & trials.apart_m.isna()]
    highest = healthy.groupby(["policy", "seed"]).near.max()
    return highest.groupby("policy").quantile(SPECIFICITY, interpolation="higher")


def outcomes(trials: pd.DataFrame, limits: pd.Series) -> pd.DataFrame:
    """A row for each policy and test patient: presses and seconds to the first word, whether it was right, how far off it was."""
    rows = []
    for (name, seed), trial in trials[trials.seed >= TUNE_SEEDS].groupby(["policy", "seed"]):
        said = np.flatnonzero(trial.near.to_numpy() > float(limits.loc[str(name)]))
        lump, budget = bool(trial.apart_m.notna().any()), len(trial)
        k = int(said[0]) if len(said) else budget - 1
        apart = float(trial.apart_m.iloc[k])
        right = lump and bool(len(said)) and apart <= NEAR_M
        presses = k + 1 if right else budget
        took = float(trial.seconds.iloc[k if right else budget - 1])
        whole = float(trial.seconds.iloc[-1])
        rows.append((str(name), seed, lump, bool(len(said)), right, presses, took, apart, whole))
    return pd.DataFrame(rows, columns=["policy", "seed", "lump", "said", "right", "presses", "seconds", "apart_m", "whole_s"])


def in_words(values: Array, quantile: float, rng: np.random.Generator) -> str:
    """Return a quantile of values, and its 95 % interval."""
    drawn = values[rng.integers(0, len(values), (_BOOTSTRAPS, len(values)))]
    low, high = np.quantile(np.quantile(drawn, quantile, axis=1), (0.025, 0.975))
    return _words((float(np.quantile(values, quantile)), float(low), float(high)), "{:.0f}")


def _mean(values: Array, rng: np.random.Generator) -> tuple[float, float, float]:
    """Return the mean of values, and its 95 % interval."""
    means = values[rng.integers(0, len(values), (_BOOTSTRAPS, len(values)))].mean(axis=1)
    low, high = np.quantile(means, (0.025, 0.975))
    return float(values.mean()), float(low), float(high)


def against_raster(found: pd.DataFrame) -> str:
    """Seconds that ours takes to the sensitivity of the whole raster, over those that the raster takes."""
    ill = found[found.lump]
    of = {name: ill[ill.policy == name].set_index("seed").sort_index() for name in (OURS, "raster")}
    right = of["raster"].right.to_numpy()
    whole = float(of["raster"].whole_s.median())
    ours = np.where(of[OURS].right, of[OURS].seconds, np.inf)
    rng = np.random.Generator(np.random.PCG64(0))
    drawn = rng.integers(0, len(ours), (_BOOTSTRAPS, len(ours)))
    ratios = [_reached(ours[k], right[k].mean()) / whole for k in drawn]
    low, high = np.quantile(ratios, (0.025, 0.975), method="nearest")
    return (
        f"the raster finds {share(int(right.sum()), len(right))} in {whole:.0f} s; ours has found as many after "
        f"{_words((_reached(ours, right.mean()) / whole, float(low), float(high)), '{:.2f}')} of that time"
    )


def _reached(seconds: Array, share: float) -> float:
    """When a share of all is found [s]; infinite where it never is."""
    return float(np.sort(seconds)[max(int(np.ceil(share * len(seconds))) - 1, 0)])


def table(found: pd.DataFrame, limits: pd.Series, trials: pd.DataFrame) -> str:
    """Return the comparison, as Markdown."""
    there = trials[(trials.seed >= TUNE_SEEDS) & trials.apart_m.notna()]
    rng = np.random.Generator(np.random.PCG64(0))
    lines = [
        "| policy | place right after 10 presses | after 30 | threshold | found | healthy without a finding "
        "| presses, median | presses, 90 % | seconds, median | area under the curve | presses against ours |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    ours = found[(found.policy == OURS) & found.lump].set_index("seed").presses
    order = found[found.lump].groupby("policy").presses.mean().sort_values().index
    for name in order:
        mine = found[found.policy == name]
        ill, well = mine[mine.lump], mine[~mine.lump]
        k, n = int(ill.right.sum()), len(ill)
        quiet, healthy = int((~well.said).sum()), len(well)
        cells = [f"`{name}`"]
        for press in (10, 30):
            apart = there[(there.policy == name) & (there.press == press)].apart_m
            cells.append(share(int((apart <= NEAR_M).sum()), len(apart)))
        cells += [f"{limits[str(name)]:.2f}", share(k, n), share(quiet, healthy)]
        values = ill.presses.to_numpy(dtype=float)
        cells += [in_words(values, q, rng) for q in (0.5, 0.9)]
        cells.append(in_words(ill.seconds.to_numpy(), 0.5, rng))
        cells.append(_words(_mean(1.0 - values / found.presses.max(), rng), "{:.2f}"))
        both = ill.set_index("seed").presses
        pairs = np.log(both / ours.reindex(both.index)).dropna().to_numpy()
        middle, low, high = np.exp(_mean(pairs, rng))
        cells.append("" if name == OURS else _words((middle, low, high), "{:.2f}"))
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def share(k: int, n: int) -> str:
    """Return a share, k of n, with its 95 % interval."""
    if not n:
        return "none of them"
    low, high = proportion_confint(k, n, method="wilson")
    return f"{k} of {n}: {100 * k / n:.0f} % ({100 * low:.0f} to {100 * high:.0f})"


def _words(values: tuple[float, float, float], form: str) -> str:
    middle, low, high = (form.format(value) for value in values)
    return f"{middle} ({low} to {high})"


def drawn(found: pd.DataFrame, trials: pd.DataFrame) -> Figure:
    """Sensitivity against presses and against seconds, and the distance of the most probable place from the lump."""
    figure = Figure(figsize=(12, 4), dpi=110, layout="constrained")
    by_press, by_second, place = figure.subplots(1, 3)
    budget = int(found.presses.max())
    for name, mine in found[found.lump].groupby("policy"):
        style = {"lw": 2.4, "color": "black", "zorder": 5} if name == OURS else {"lw": 1.1}
        right, n = mine[mine.right], len(mine)
        presses = np.arange(1, budget + 1)
        shares = np.array([(right.presses <= k).sum() for k in presses])
        (line,) = by_press.plot(presses, shares / n, label=str(name), **style)
        low, high = proportion_confint(shares, n, method="wilson")
        by_press.fill_between(presses, low, high, color=line.get_color(), alpha=0.15 if name == OURS else 0.06, lw=0)
        grid = np.linspace(0, float(found.seconds.max()), 200)
        by_second.plot(grid, [(right.seconds <= t).mean() * len(right) / n if len(right) else 0.0 for t in grid], **style)
        apart = trials[(trials.policy == name) & trials.seed.isin(mine.seed)].groupby("press").apart_m.median()
        place.plot(apart.index, 1e3 * apart, **style)
    by_press.set(xlabel="presses", ylabel=f"lumps found at specificity {SPECIFICITY:.2f}", ylim=(0, 1), title="sensitivity")
    by_second.set(xlabel="seconds", ylim=(0, 1), title="sensitivity")
    place.set(xlabel="presses", ylabel="most probable place from the lump, median [mm]", title="localisation", ylim=(0, None))
    place.legend(*by_press.get_legend_handles_labels(), fontsize=7, loc="upper right")
    return figure


def main(
    folder: Annotated[Path, typer.Argument(help="Folder of trials.")] = Path("out/search-study"),
    hand: Annotated[str, typer.Option(help="Trials of which hand.")] = "surrogate",
    picture: Annotated[Path | None, typer.Option(help="Where to draw the curves.")] = None,
    outcome: Annotated[Path | None, typer.Option(help="CSV file of the results of each search.")] = None,
) -> None:
    """Compare the policies of the trials in a folder."""
    files = sorted(folder.glob(f"{hand}-*.csv"))
    if not files:
        raise typer.BadParameter(f"{folder}: there are no trials of the hand {hand}")
    trials = pd.concat([pd.read_csv(file) for file in files], ignore_index=True)
    limits = thresholds(trials)
    found = outcomes(trials, limits)
    tuned = trials[trials.seed < TUNE_SEEDS].seed.nunique()
    print(f"{found.seed.nunique()} patients, {found[found.lump].seed.nunique()} with a lump; {tuned} healthy tuning patients\n")
    print(table(found, limits, trials))
    print(f"\n{against_raster(found)}")
    if outcome is not None:
        found.round(4).to_csv(outcome, index=False)
    if picture is not None:
        drawn(found, trials).savefig(picture)


if __name__ == "__main__":
    typer.run(main)
