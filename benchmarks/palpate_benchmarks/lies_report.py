"""The campaign of lies on one screen: a matrix of topics and lies, and a table by kind of lie."""

from collections import Counter
from collections.abc import Sequence
from enum import StrEnum
from pathlib import Path

import numpy as np
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure

from palpate_benchmarks.fault_cases import FaultFinding, by_code
from palpate_benchmarks.liar import KINDS
from palpate_benchmarks.lies import LEFT_OUT, UNDETECTABLE, left_out
from palpate_bus.contract import contract


class LieVerdict(StrEnum):
    """Result of a case, from the best to the worst."""

    REFUSED = "refused at the port"
    NAMED = "named by a service"
    HARMLESS = "no harm"
    UNDETECTABLE = "not detectable"
    BAD = "bad"


COLOURS = {
    LieVerdict.REFUSED: "#1b7837",
    LieVerdict.NAMED: "#7fbf7b",
    LieVerdict.HARMLESS: "#d9f0d3",
    LieVerdict.UNDETECTABLE: "#fee08b",
    LieVerdict.BAD: "#c51b7d",
}
RANKS = tuple(LieVerdict)


def verdict(finding: FaultFinding) -> LieVerdict:
    """Return the verdict on a case."""
    if not finding.good:
        return LieVerdict.BAD
    if finding.outcome.unharmed:
        return LieVerdict.HARMLESS
    if finding.sign.startswith("not detectable"):
        return LieVerdict.UNDETECTABLE
    return LieVerdict.REFUSED if " refused: " in finding.ended else LieVerdict.NAMED


def figure(findings: Sequence[FaultFinding], path: Path) -> None:
    """Write the matrix: in each cell the number of cases, in the colour of the worst."""
    topics = [name for name in contract().topics if any(f.where.split()[0] == name for f in findings)]
    worst, count = np.full((len(topics), len(KINDS)), np.nan), np.zeros((len(topics), len(KINDS)), int)
    for finding in findings:
        topic, _, kind, *_ = finding.where.split()
        cell = topics.index(topic), KINDS.index(kind)
        count[cell] += 1
        worst[cell] = np.nanmax((worst[cell], RANKS.index(verdict(finding))))
    shown = Figure(figsize=(12, 0.34 * len(topics) + 2), layout="constrained")
    axes = shown.subplots()
    axes.imshow(worst, cmap=ListedColormap([COLOURS[one] for one in RANKS]), vmin=0, vmax=len(RANKS) - 1, aspect="auto")
    for row, column in zip(*np.nonzero(count), strict=True):
        axes.text(column, row, str(count[row, column]), ha="center", va="center", fontsize=8)
    axes.set_xticks(range(len(KINDS)), KINDS, rotation=45, ha="right")
    axes.set_yticks(range(len(topics)), topics)
    for one in RANKS:
        axes.plot([], [], "s", color=COLOURS[one], markersize=9, label=one)
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, 1.13), ncols=len(RANKS), frameon=False)
    shown.savefig(path, dpi=110)


def markdown(findings: Sequence[FaultFinding]) -> str:
    """Return the table by kind of lie, the bad cases, and what was left out or cannot be detected."""
    head = ("lie", "cases", *RANKS, "largest force [N]")
    lines = [f"| {' | '.join(head)} |", "|---" * len(head) + "|"]
    for kind in KINDS:
        mine = [f for f in findings if f.where.split()[2] == kind]
        if mine:
            counts = Counter(map(verdict, mine))
            force = max(f.peak_force_n or 0.0 for f in mine)
            lines.append(f"| {kind} | {len(mine)} | {' | '.join(str(counts[one]) for one in RANKS)} | {force:.1f} |")
    good = sum(f.good for f in findings)
    wallclock = sum(f.mode == "wall clock" for f in findings)
    lines = [
        f"{good} of {len(findings)} cases passed, {wallclock} of them in wall-clock mode. {by_code(findings)}",
        "",
        *lines,
        "",
    ]
    lines += [f"- **!** {f.where}: {f.ended}" for f in findings if not f.good]
    lines += [f"- not detectable: {topic} {kinds or 'all'}: {why}" for topic, kinds, why in UNDETECTABLE]
    out = {topic.name: left_out(topic) for topic in contract().topics.values() if left_out(topic)} | LEFT_OUT
    reasons = {why: [name for name in out if out[name] == why] for why in out.values()}
    lines += [f"- left out, {why}: {', '.join(names)}" for why, names in reasons.items()]
    return "\n".join(lines) + "\n"
