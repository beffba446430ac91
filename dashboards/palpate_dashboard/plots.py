"""Plots, states and log next to the scene, and force over depth. Numbers in, rerun entities out.

Force over depth is drawn in a 2-D view, because rerun's plots only have time on the x axis. Its x is depth [mm] and its y
is minus force [N], as image axes point down, both times `PLOT.stretch`.
"""

from collections.abc import Mapping
from itertools import cycle, islice
from typing import Final, NamedTuple

import numpy as np
import rerun as rr

from palpate_bus.contract import contract
from palpate_dashboard import palette
from palpate_dashboard.sinks import Canvas, scalars
from palpate_dashboard.text import LEVELS, Health


class PlotTuning(NamedTuple):
    """Scale and detail of the plots."""

    stretch: float = 10.0
    flush: int = 20
    """Samples per piece of the curve: one second."""
    depth_floor_m: float = -0.02
    """The depth plot is blank further above the surface than this: free motion would flatten the contact to a line."""


PLOT: Final = PlotTuning()
_AXIS: Final = (150, 150, 150, 255)


class ForceDepthPlane:
    """Extent of the force-depth plane."""

    def __init__(self, depth_m: float, force_limit_n: float) -> None:
        """`depth_m`: target depth of the examination; `force_limit_n`: its working limit."""
        self.wanted_mm = 1e3 * depth_m
        self.depth_max_mm = max(2.0 * self.wanted_mm, 10.0)
        self.force_max_n = force_limit_n
        self.size = (PLOT.stretch * self.depth_max_mm, PLOT.stretch * self.force_max_n)

    @property
    def bounds(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Return the visible x and y ranges of the plane."""
        x, y = self.size
        return (-0.16 * x, 1.08 * x), (-1.08 * y, 0.26 * y)


class ForceDepth:
    """Draws the force-depth plane under `force_depth`."""

    def __init__(self, canvas: Canvas, plane: ForceDepthPlane) -> None:
        self._canvas = canvas
        self._past: list[tuple[float, float]] = []
        self._new = 0
        x, y = plane.size
        lines = [[(0, 0), (x, 0)], [(0, 0), (0, -y)]]
        depths, forces = np.arange(0, plane.depth_max_mm + 0.1, 5.0), np.arange(0, plane.force_max_n + 0.1, 5.0)
        lines += [[(PLOT.stretch * d, 0), (PLOT.stretch * d, 0.02 * y)] for d in depths]
        lines += [[(0, -PLOT.stretch * f), (-0.015 * x, -PLOT.stretch * f)] for f in forces]
        canvas.log("force_depth/axes", rr.LineStrips2D(lines, colors=[_AXIS], radii=[rr.Radius.ui_points(0.7)]))
        places = [(PLOT.stretch * d, 0.06 * y) for d in depths] + [(-0.06 * x, -PLOT.stretch * f) for f in forces[1:]]
        words = [f"{d:.0f} mm" for d in depths] + [f"{f:.0f} N" for f in forces[1:]]
        marks = rr.Points2D(places, labels=words, colors=[_AXIS], radii=[0.01], show_labels=True)
        canvas.log("force_depth/axes/ticks", marks)
        wanted = [[(PLOT.stretch * plane.wanted_mm, 0), (PLOT.stretch * plane.wanted_mm, -y)]]
        guide = rr.LineStrips2D(wanted, colors=[(230, 230, 230, 120)], radii=[rr.Radius.ui_points(0.5)])
        canvas.log("force_depth/wanted_depth", guide)

    def add(self, t: int, depth_m: float, force_n: float) -> None:
        """Add a sample in contact at simulated time `t` [ns]. The latest piece is drawn as a line, earlier ones as dots."""
        self._past.append((PLOT.stretch * 1e3 * depth_m, -PLOT.stretch * force_n))
        self._new += 1
        if self._new < PLOT.flush:
            return
        bright = rr.LineStrips2D([self._past[-self._new - 1 :]], colors=[palette.FORCE], radii=[rr.Radius.ui_points(1.5)])
        self._canvas.log("force_depth/now", bright, t)
        dots = rr.Points2D(self._past[-self._new :], colors=[palette.PLANNED], radii=[rr.Radius.ui_points(1.2)])
        self._canvas.log("force_depth/past", dots, t)
        self._new = 0
        del self._past[:-1]


PHASES: Final = (
    ("home", (120, 130, 145)),
    ("look", (70, 160, 255)),
    ("plan", (150, 110, 240)),
    ("approach", (90, 190, 190)),
    ("indent", (240, 200, 60)),
    ("scan", (255, 140, 40)),
    ("retract", (90, 190, 190)),
    ("return", (120, 130, 145)),
    ("assess", (190, 60, 255)),
    ("done", (70, 190, 90)),
    ("aborted", (220, 40, 40)),
    ("held", (230, 120, 200)),
)
"""Phases by number (ExamState.PHASE_*), with their colours."""

MODES: Final = (("idle", (120, 130, 145)), ("active", (70, 190, 90)), ("safe hold", (220, 40, 40)))
"""Driver modes by number (RobotStatus.MODE_*)."""

LEVEL_COLORS: Final = ((70, 190, 90), (240, 200, 60), (220, 40, 40), (120, 130, 145))
"""Colours of `text.LEVELS`, in their order."""
_LOG_LEVELS: Final = {"warning": "WARN", "ERROR": "ERROR"}

JOINT_COLORS: Final = (
    (230, 80, 80), (240, 150, 50), (220, 200, 60), (110, 190, 90), (70, 180, 200), (80, 120, 230), (170, 90, 220),
)  # fmt: skip
AWAITED: Final = (*(name for name, role in contract().roles.items() if not role.observer), "grant")
"""Possible causes of a wait: the services, and the conductor's grant of simulated time."""
_TRUE, _THIN, _WIDE = (150, 110, 240), 1.0, 1.5
SERIES: Final[Mapping[str, tuple[str, tuple[int, int, int], float]]] = {
    "force/measured": ("measured [N]", (255, 110, 110), _WIDE),
    "force/true": ("true [N]", _TRUE, _WIDE),
    "force/limit": ("working limit [N]", (240, 200, 60), _THIN),
    "depth/measured": ("measured [mm]", (255, 170, 40), _WIDE),
    "depth/setpoint": ("set-point [mm]", (230, 230, 230), _THIN),
    "depth/true": ("true [mm]", _TRUE, _WIDE),
    "truth/breath": ("true breath [mm]", _TRUE, _WIDE),
    "truth/moved": ("true motion of the umbilicus [mm]", (240, 200, 60), _WIDE),
    "wall/displacement": ("followed [mm]", (255, 170, 40), _WIDE),
    "wall/forecast": ("forecast 0.2 s before [mm]", (230, 230, 230), _THIN),
    "speed/real_time_factor": ("real-time factor [1]", (70, 180, 200), _WIDE),
    "progress/targets": ("targets visited [%]", (70, 190, 90), _WIDE),
}
"""Name, colour and width of each line, by its path below `plots`."""


def depth_mm(depth_m: float) -> float:
    """Return a depth for its plot [mm]; NaN in free motion."""
    return 1e3 * depth_m if depth_m > PLOT.depth_floor_m else float("nan")


class Plots:
    """Draws plots, states and log."""

    def __init__(self, canvas: Canvas, legend: str) -> None:
        """`legend`: a page in Markdown."""
        self._canvas = canvas
        self._texts: dict[str, str] = {}
        self._health_lines: set[str] = set()
        canvas.log("text/legend", rr.TextDocument(legend, media_type=rr.MediaType.MARKDOWN))
        for path, (name, color, width) in SERIES.items():
            canvas.log(f"plots/{path}", rr.SeriesLines(names=[name], colors=[color], widths=[width]))
        for path, names in (("torque/joints", [f"A{i + 1} [% of limit]" for i in range(7)]), ("waits/roles", AWAITED)):
            colors = list(islice(cycle((*JOINT_COLORS, (190, 190, 190))), len(names)))
            canvas.log(f"plots/{path}", rr.SeriesLines(names=names, colors=colors, widths=[_WIDE] * len(names)))
        for path, states in (("state/phase", PHASES), ("state/driver", MODES)):
            canvas.log(path, rr.StateConfiguration(values=[name for name, _ in states], colors=[color for _, color in states]))

    def add(self, t: int, path: str, *values: float) -> None:
        """Plot the values of the lines of a path below `plots` at `t` [ns]."""
        self._canvas.add(f"plots/{path}", scalars, t, np.array(values, dtype=np.float64))

    def state(self, t: int, path: str, name: str) -> bool:
        """Write a state when it changes; return True if it did."""
        if changes := self._changes(path, name):
            self._canvas.log(path, rr.StateChange(state=name), t)
        return changes

    def health(self, t: int, row: Health) -> None:
        """Draw the health line of a service or topic, and log its message unless it is ok."""
        path = f"health/{'topics' if row.is_topic else 'services'}/{row.name}"
        if path not in self._health_lines:
            self._health_lines.add(path)
            self._canvas.log(path, rr.StateConfiguration(values=list(LEVELS), colors=list(LEVEL_COLORS)))
        self.state(t, path, row.word)
        if row.word in _LOG_LEVELS:
            self.log(t, f"log/{path}", row.message, _LOG_LEVELS[row.word])

    def log(self, t: int, path: str, text: str, level: str = "INFO") -> None:
        """Log a line unless it equals the previous one on this path."""
        if text and self._changes(path, text):
            self._canvas.log(path, rr.TextLog(text, level=level), t)

    def document(self, t: int, path: str, markdown: str) -> None:
        """Write a page of text when it changes."""
        if self._changes(path, markdown):
            self._canvas.log(path, rr.TextDocument(markdown, media_type=rr.MediaType.MARKDOWN), t)

    def _changes(self, path: str, text: str) -> bool:
        before, self._texts[path] = self._texts.get(path), text
        return text != before
