"""`palpate plan`: the plan of an examination on the true surface: strokes, touches, skipped targets, duration."""

from __future__ import annotations

import math
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NamedTuple

import typer

from palpate.console import SteadyConsole, refuse
from palpate.run.options import DEFAULT_SCENARIO, ScenarioName, Seed, Settings

if TYPE_CHECKING:
    from palpate_models.numerics.frames import Array
    from palpate_models.patient.phantom import PhantomModel
    from palpate_models.scenario.patterns import Scan
    from palpate_models.scenario.schema import Exam, Scenario
    from palpate_planning.reasons import Cause


def plan(
    scenario: ScenarioName = DEFAULT_SCENARIO,
    out: Annotated[Path, typer.Option("--out", "-o", help="The picture, a PNG file.")] = Path("plan.png"),
    seed: Seed = None,
    settings: Settings = None,
) -> None:
    """Draw the plan of an examination: its targets, their order, the duration, and targets out of reach.

    It is planned as in the examination, but on the patient's true surface; a camera has an error of some millimetres.

    [bold]Examples[/]

      palpate plan                                        the default examination

      palpate plan --set exam.pattern=spiral.py           a custom scan pattern

      palpate plan person --seed 3 --set exam.spacing_m=0.02 -o plan.png
    """
    from palpate.apart import run_guarded
    from palpate.run.inputs import check_usable
    from palpate_models.patient.phantom import build_phantom
    from palpate_planning.motion.planner import NoPathError

    if out.suffix.lower() != ".png":
        refuse(f"--out {out}: expected the name of a .png file")
    chosen = check_usable(scenario, settings, seed)
    try:
        with SteadyConsole(stderr=True).status("planning: about ten seconds"):
            phantom = build_phantom(chosen.phantom, chosen.seed)
            check_tissue(chosen, phantom)
            planned = run_guarded(f"exam.pattern = {chosen.exam.pattern!r}", lambda: prospect(chosen, phantom), math.inf)
            draw(out, chosen, phantom, planned)
    except NoPathError as error:
        refuse(f"{error}; to find where the base should stand: palpate arm place {chosen.robot.arm} {scenario}")
    console = SteadyConsole()
    console.print(summary(chosen.exam, planned), soft_wrap=True)
    for reason, count in sorted(Counter(cause.text for cause in planned.skipped.values()).items()):
        console.print(f"{count} targets are left out: {reason}", soft_wrap=True)
    console.print(f"drawn in {out}", soft_wrap=True)


class Prospect(NamedTuple):
    """A planned examination."""

    scan: Scan
    strokes: tuple[Array, ...]
    """Paths of the indenter at depth, xy in A [m], shape (n, 2) each, in order."""
    touches: Array
    """Places of the touches before the scan, xy in A [m], shape (k, 2)."""
    skipped: dict[int, Cause]
    """Reason for each skipped target."""
    duration_s: float
    """Estimated duration in simulated time."""

    @property
    def length_m(self) -> float:
        """Path length in contact."""
        import numpy as np

        return float(sum(np.linalg.norm(np.diff(stroke, axis=0), axis=1).sum() for stroke in self.strokes))


def check_tissue(scenario: Scenario, phantom: PhantomModel) -> None:
    """Raise UserError if the default tissue could not be stepped on this phantom's mesh."""
    from palpate_bus.contract import contract
    from palpate_bus.messages import NS
    from palpate_tissue.backends.winkler.implicit import assemble

    if scenario.services.tissue == "winkler":
        assemble(phantom, scenario.phantom.stiffness).substeps(contract().roles["tissue"].period / NS)


def prospect(scenario: Scenario, phantom: PhantomModel) -> Prospect:
    """Return the plan on the true rest surface, as registered. Raises PluginError, and NoPathError if no target is in reach."""
    import numpy as np
    from scipy.spatial import Delaunay

    from palpate.quick.patient import PERIOD_S, seen_lattice
    from palpate.run.inputs import Outlook, scan_over, surface_of
    from palpate_models.numerics.frames import apply, inverse
    from palpate_models.robot.arm import arm_of
    from palpate_models.scenario.load import exam_input
    from palpate_planning.strokes.plan import ExamPlanner, PerceivedAbdomen
    from palpate_planning.wall.surface import PerceivedSurface

    scan = scan_over(scenario, phantom)
    known = exam_input(scenario)
    X_WA = np.array(known.X_WA)
    p_A, n_A = surface_of(phantom).points(seen_lattice(scenario.exam))
    seen = np.isfinite(p_A).all(axis=1) & np.isfinite(n_A).all(axis=1)
    p_W, n_W = apply(X_WA, p_A[seen]), n_A[seen] @ X_WA[:3, :3].T
    triangles = Delaunay(p_A[seen, :2]).simplices.astype(np.int64)
    surface = PerceivedSurface.from_mesh(p_W, n_W, X_WA)
    positions, _ = surface.at(scan.targets)
    seen_abdomen = PerceivedAbdomen(positions, scan.line_of_target, p_W, triangles, surface)
    plan = ExamPlanner(known, PERIOD_S).examination(seen_abdomen, arm_of(known.robot).home_rad)
    contacts = [segment for segment in plan.segments if segment.contact]
    ways = [apply(inverse(X_WA), segment.path.p)[:, :2] for segment in contacts if not segment.touch]
    touches = [apply(inverse(X_WA), segment.path.p)[0, :2] for segment in contacts if segment.touch]
    return Prospect(scan, tuple(ways), np.array(touches).reshape(-1, 2), plan.skipped, Outlook.of(scenario.exam).duration_s)


def summary(exam: Exam, planned: Prospect) -> str:
    """Return the numbers of targets or presses, lines, strokes and touches, and the duration, as a line."""
    from palpate_models.scenario.schema import Mode

    targets, touches = len(planned.scan.targets), _count_text(len(planned.touches), "touch", "touches")
    time = f"{planned.duration_s:.0f} s of simulated time"
    if exam.searched:
        return f"{targets} places, at most {exam.budget.presses} presses; {touches} before the search; at most {time}"
    lines, strokes = _count_text(len(planned.scan.lines), "line"), _count_text(len(planned.strokes), "stroke")
    slides = f"{planned.length_m:.2f} m of sliding" if exam.mode is Mode.CONTINUOUS else "pressed one by one"
    return f"{targets} targets in {lines}, palpated in {strokes}; {slides}, {touches} before; about {time}"


def _count_text(number: int, one: str, many: str = "") -> str:
    return f"{number} {one if number == 1 else many or one + 's'}"


def draw(path: Path, scenario: Scenario, phantom: PhantomModel, planned: Prospect) -> None:
    """Draw the plan on the body, seen from the front with the head at the top, into a PNG file. Raises OSError."""
    import numpy as np
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.5, 8.0), dpi=110, facecolor="white", layout="constrained")
    axes = figure.add_subplot()
    mm, contours = 1e3, "#c9d1d4"
    front = phantom.normals[:, 2] > 0.1
    x, y, z = phantom.vertices[front].T * mm
    axes.tricontour(x, y, z, levels=10, colors=contours, linewidths=0.8)
    axes.plot([], [], color=contours, linewidth=0.8, label="equal height of the skin")
    used = np.array([i not in planned.skipped for i in range(len(planned.scan.targets))])
    for k, stroke in enumerate(planned.strokes):
        label = "stroke, which may leave the region where it turns" if k == 0 else None
        axes.plot(*(stroke.T * mm), color="#7a8c94", linewidth=1.2, zorder=2, label=label)
    order = np.flatnonzero(used)
    targets = planned.scan.targets * mm
    dots = axes.scatter(targets[used, 0], targets[used, 1], c=order, cmap="viridis", s=22, zorder=3)
    figure.colorbar(dots, ax=axes, label="number of the place" if scenario.exam.searched else "order of the targets", shrink=0.75)
    if len(planned.touches):
        x, y = planned.touches.T * mm
        axes.scatter(x, y, marker="o", s=130, facecolors="none", edgecolors="#d07000", label="touch", zorder=4)
    if not used.all():
        axes.scatter(targets[~used, 0], targets[~used, 1], marker="x", s=50, color="#c00000", label="left out", zorder=5)
    if len(planned.strokes):
        axes.plot(*(planned.strokes[0][0] * mm), "*", markersize=15, color="#c000a0", label="begins here", zorder=6)
    (cx, cy), (width, height) = scenario.exam.centre_m, scenario.exam.region_m
    margin = 0.03
    axes.set_xlim((cx - width / 2 - margin) * mm, (cx + width / 2 + margin) * mm)
    axes.set_ylim((cy - height / 2 - margin) * mm, (cy + height / 2 + margin) * mm)
    axes.set(aspect="equal", xlabel="x, to the patient's left [mm]", ylabel="y, to the head [mm]")
    figure.legend(loc="outside lower center", ncols=2, fontsize=9)
    exam = scenario.exam
    how = f"{Path(exam.pattern).stem}, {exam.mode}, {_count_text(len(planned.strokes), 'stroke')}, about"
    how = f"search, at most {exam.budget.presses} presses, at most" if exam.searched else how
    axes.set_title(f"{scenario.name}: {how} {planned.duration_s:.0f} s", parse_math=False)
    figure.savefig(path)
