"""A planned examination as a picture: targets in their order, strokes, touches, and what is out of reach."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from palpate.plan.prospect import Prospect
from palpate_models.patient.phantom import PhantomModel
from palpate_models.scenario.schema import Scenario

MM = 1e3
CONTOURS = "#c9d1d4"


def draw(path: Path, scenario: Scenario, phantom: PhantomModel, planned: Prospect) -> None:
    """Writes the picture: the body from above, its head at the top, its left to the right. Raises OSError."""
    figure = Figure(figsize=(8.5, 8.0), dpi=110, facecolor="white", layout="constrained")
    axes = figure.add_subplot()
    front = phantom.normals[:, 2] > 0.1
    x, y, z = phantom.vertices[front].T * MM
    axes.tricontour(x, y, z, levels=10, colors=CONTOURS, linewidths=0.8)
    axes.plot([], [], color=CONTOURS, linewidth=0.8, label="equal height of the skin")
    used = np.array([i not in planned.skipped for i in range(len(planned.scan.targets))])
    for stroke in planned.strokes:
        axes.plot(*(stroke.T * MM), color="#7a8c94", linewidth=1.2, zorder=2)
    order = np.flatnonzero(used)
    targets = planned.scan.targets * MM
    dots = axes.scatter(targets[used, 0], targets[used, 1], c=order, cmap="viridis", s=22, zorder=3)
    figure.colorbar(dots, ax=axes, label="number of the place" if scenario.exam.searched else "order of the targets", shrink=0.75)
    if len(planned.touches):
        x, y = planned.touches.T * MM
        axes.scatter(x, y, marker="o", s=130, facecolors="none", edgecolors="#d07000", label="touch", zorder=4)
    if not used.all():
        axes.scatter(targets[~used, 0], targets[~used, 1], marker="x", s=50, color="#c00000", label="left out", zorder=5)
    if len(planned.strokes):
        axes.plot(
            *(planned.strokes[0][0] * MM), marker="*", markersize=15, color="#c000a0", linestyle="", label="begins here", zorder=6
        )
    (cx, cy), (width, height) = scenario.exam.centre_m, scenario.exam.region_m
    margin = 0.03
    axes.set_xlim((cx - width / 2 - margin) * MM, (cx + width / 2 + margin) * MM)
    axes.set_ylim((cy - height / 2 - margin) * MM, (cy + height / 2 + margin) * MM)
    axes.set_aspect("equal")
    axes.set_xlabel("x, to the patient's left [mm]")
    axes.set_ylabel("y, to the head [mm]")
    axes.legend(loc="upper right", fontsize=9)
    exam = scenario.exam
    if exam.searched:
        how = f"search, at most {exam.budget.presses} presses, at most"
    else:
        strokes = "1 stroke" if len(planned.strokes) == 1 else f"{len(planned.strokes)} strokes"
        how = f"{Path(exam.pattern).stem}, {exam.mode}, {strokes}, about"
    axes.set_title(f"{scenario.name}: {how} {planned.duration_s:.0f} s")
    figure.savefig(path)
