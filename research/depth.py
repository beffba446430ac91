"""Error of the reported depth and of its uncertainty, and depth of first contact of descents: recordings against the truth.

Run: `python -m research.depth FOLDER... [--picture FILE.png]`, each FOLDER that of a `palpate run --record normal`.
"""

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from palpate_bus.contract import contract
from palpate_bus.messages import NS, codec
from palpate_bus.recordings import open_recording
from palpate_models.numerics.frames import Array
from palpate_validation.check import COLOURS, write_figure

STATES, TRUTH = "exam/state", "truth/indentation"
ENOUGH = 20
"""Minimum number of states of a stroke."""
PRESSED_M = 0.002
"""Depth from which a press has an after-effect [m]."""
NEAR_M = 0.014
"""no farther than this from the indenter: so wide is the contact at the examination's depth."""


@dataclass(frozen=True)
class Depths:
    """Reported depth of an examination and its error, n states."""

    time: Array
    """[s], shape (n,)."""
    error: Array
    """Reported minus true depth [m], shape (n,)."""
    sigma: Array
    """Reported standard deviation [m], shape (n,)."""
    stroke: NDArray[np.int64]
    """Number of the descent, shape (n,)."""

    def by_stroke(self) -> tuple[float, float]:
        """Standard deviation [m] of the strokes' mean errors, and root mean square of what is left within strokes."""
        strokes = [self.error[self.stroke == k] for k in np.unique(self.stroke) if np.count_nonzero(self.stroke == k) >= ENOUGH]
        return float(np.std([e.mean() for e in strokes])), float(np.sqrt(np.mean([e.var() for e in strokes])))


def read(folder: Path) -> Depths:
    """Depths of a recorded run. Raises RecordingError."""
    rows: list[tuple[float, float, float, int]] = []
    truth: list[tuple[float, float]] = []
    for message in open_recording(folder).messages((STATES, TRUTH)):
        decoded = codec.decode(message.payload, contract().topics[message.topic].type)
        if message.topic == TRUTH:
            truth.append((message.stamp / NS, decoded.depth))
        elif decoded.steady:
            rows.append((message.stamp / NS, decoded.depth, decoded.depth_uncertainty, decoded.stroke))
    time, depth, sigma, stroke = (np.array(column) for column in zip(*rows, strict=True))
    true_time, true = np.array(truth).T
    return Depths(time, depth - np.interp(time, true_time, true), sigma, stroke.astype(np.int64))


class Met(NamedTuple):
    """First contact of a descent."""

    depth: float
    """Below the skin as it was before it was ever pressed [m]."""
    pressed: bool
    """True if the skin there or near it was pressed before."""


def where_met(folder: Path) -> list[Met]:
    """Return the first contacts of the descents of a recorded run, by the true force. Raises RecordingError."""
    began: dict[int, float] = {}
    rows: list[tuple[float, ...]] = []
    for message in open_recording(folder).messages((STATES, TRUTH)):
        decoded, t = codec.decode(message.payload, contract().topics[message.topic].type), message.stamp / NS
        if message.topic == STATES:
            began.setdefault(decoded.stroke, t)
        else:
            p = decoded.surface_point
            rows.append((t, decoded.depth, decoded.normal_force, p.x, p.y, p.z))
    return met_by(began, np.array(rows))


def met_by(began: Mapping[int, float], truth: Array) -> list[Met]:
    """Return the same of descents that began at times [s]; `truth` has rows of time, depth, force and place [m], shape (n, 6)."""
    time, depth, force = truth.T[:3]
    met = []
    for stroke, begin in began.items():
        at = int(np.argmax((time >= begin) & (force > 0)))
        if stroke == 0 or at == 0:
            continue
        near = np.linalg.norm(truth[:, 3:] - truth[at, 3:], axis=1) < NEAR_M
        met.append(Met(float(depth[at]), bool(np.any((time < begin) & (depth > PRESSED_M) & near))))
    return met


def contact_summary(met: Sequence[Met]) -> str:
    """Return a sentence about the contacts."""
    depth, pressed = (np.array(column) for column in zip(*met, strict=True))
    parts = []
    for which, where in ((~pressed, "where it was not pressed before"), (pressed, "near earlier presses")):
        if which.any():
            parts.append(f"{1e3 * depth[which].mean():.2f} mm +- {1e3 * depth[which].std():.2f} ({which.sum()} descents) {where}")
    return f"the tissue is met below the skin as it was at first, {', '.join(parts)}"


def row(name: str, depths: Depths) -> str:
    """Return a row of the table."""
    between, within = (1e3 * x for x in depths.by_stroke())
    wrong, reported = (1e3 * float(np.sqrt(np.mean(x**2))) for x in (depths.error, depths.sigma))
    strokes = len(np.unique(depths.stroke))
    figures = (f"{x:.2f}" for x in (wrong, reported, wrong / reported, between, within))
    cells = (name, str(len(depths.time)), str(strokes), *figures)
    return f"| {' | '.join(cells)} |"


def draw(figure: Figure, reported: Sequence[tuple[str, Depths]]) -> None:
    """Plot the error over time with the band of one reported standard deviation, one panel per examination."""
    panels = figure.subplots(len(reported), 1, sharex=True, sharey=True, squeeze=False)[:, 0]
    for panel, (name, depths) in zip(panels, reported, strict=True):
        for k in np.unique(depths.stroke):
            part = depths.stroke == k
            t, sigma = depths.time[part], 1e3 * depths.sigma[part]
            panel.fill_between(t, -sigma, sigma, color=COLOURS[0], alpha=0.2, linewidth=0)
            panel.plot(t, 1e3 * depths.error[part], color=COLOURS[1], linewidth=1)
        panel.set_title(name, loc="left")
        panel.set_ylabel("reported minus true [mm]")
    panels[-1].set_xlabel("simulated time [s]")


def main() -> None:
    """Print a table of the runs, and draw them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("--picture", type=Path)
    args = parser.parse_args()
    reported = [(folder.name, read(folder)) for folder in args.folders]
    print("| run | states | strokes | depth error, RMS [mm] | reported [mm] | ratio | between strokes [mm] | within [mm] |")
    print("|" + "---|" * 8)
    for name, depths in reported:
        print(row(name, depths))
    print()
    for folder in args.folders:
        print(f"{folder.name}: {contact_summary(where_met(folder))}")
    if args.picture is not None:
        write_figure(lambda figure: draw(figure, reported), args.picture, size_in=(7.0, 1.8 * len(reported) + 0.4))


if __name__ == "__main__":
    main()
