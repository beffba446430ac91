"""Plots, states and log next to the scene, and force over depth. Numbers in, rerun entities out.

Force over depth is drawn in a 2-D view, because rerun's plots only have time on the x axis. Its x is depth [mm] times `STRETCH`,
its y is minus force [N] times `STRETCH`: image axes point down.
"""

from collections.abc import Sequence
from itertools import cycle
from typing import Final

import numpy as np
import rerun as rr

from palpate_bus.contract import contract
from palpate_dashboard import palette
from palpate_dashboard.sinks import TIMELINE, Columns, scalars
from palpate_dashboard.text import LEVELS, Health
from palpate_models.numerics.frames import Array

STRETCH: Final = 10.0
FLUSH: Final = 20
"""Samples per piece of the curve: one second."""
_AXIS: Final = (150, 150, 150, 255)


class ForceDepthPlane:
    """Extent of the force-depth plane."""

    def __init__(self, depth_m: float, force_limit_n: float) -> None:
        """`depth_m`: target depth of the examination; `force_limit_n`: its working limit."""
        self.wanted_mm = 1e3 * depth_m
        self.depth_max_mm = max(2.0 * self.wanted_mm, 10.0)
        self.force_max_n = force_limit_n
        self.size = (STRETCH * self.depth_max_mm, STRETCH * self.force_max_n)

    @property
    def bounds(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Return the visible x and y ranges of the plane."""
        x, y = self.size
        return (-0.16 * x, 1.08 * x), (-1.08 * y, 0.26 * y)


class ForceDepth:
    """Draws the force-depth plane under `force_depth`."""

    def __init__(self, recording: rr.RecordingStream, plane: ForceDepthPlane) -> None:
        self._recording = recording
        self._past: list[tuple[float, float]] = []
        self._new = 0
        self._axes(plane)

    def _axes(self, plane: ForceDepthPlane) -> None:
        x, y = plane.size
        lines = [[(0, 0), (x, 0)], [(0, 0), (0, -y)]]
        depths, forces = np.arange(0, plane.depth_max_mm + 0.1, 5.0), np.arange(0, plane.force_max_n + 0.1, 5.0)
        lines += [[(STRETCH * d, 0), (STRETCH * d, 0.02 * y)] for d in depths]
        lines += [[(0, -STRETCH * f), (-0.015 * x, -STRETCH * f)] for f in forces]
        shape = rr.LineStrips2D(lines, colors=[_AXIS], radii=[rr.Radius.ui_points(0.7)])
        self._recording.log("force_depth/axes", shape, static=True)
        places = [(STRETCH * d, 0.06 * y) for d in depths] + [(-0.06 * x, -STRETCH * f) for f in forces[1:]]
        words = [f"{d:.0f} mm" for d in depths] + [f"{f:.0f} N" for f in forces[1:]]
        marks = rr.Points2D(places, labels=words, colors=[_AXIS], radii=[0.01], show_labels=True)
        self._recording.log("force_depth/axes/ticks", marks, static=True)
        wanted = [[(STRETCH * plane.wanted_mm, 0), (STRETCH * plane.wanted_mm, -y)]]
        guide = rr.LineStrips2D(wanted, colors=[(230, 230, 230, 120)], radii=[rr.Radius.ui_points(0.5)])
        self._recording.log("force_depth/wanted_depth", guide, static=True)

    def add(self, t: int, depth_m: float, force_n: float, in_contact: bool) -> None:
        """Add a sample at simulated time `t` [ns]; samples without contact are skipped."""
        if not in_contact:
            return
        self._past.append((STRETCH * 1e3 * depth_m, -STRETCH * force_n))
        self._new += 1
        if self._new >= FLUSH:
            self.flush(t)

    def flush(self, t: int) -> None:
        """Draw the new samples; the view shows the latest piece as a line and earlier ones as dots."""
        if not self._new:
            return
        self._recording.set_time(TIMELINE, duration=np.timedelta64(t, "ns"))
        bright = rr.LineStrips2D([self._past[-self._new - 1 :]], colors=[palette.FORCE], radii=[rr.Radius.ui_points(1.5)])
        self._recording.log("force_depth/now", bright)
        dots = rr.Points2D(self._past[-self._new :], colors=[palette.PLANNED], radii=[rr.Radius.ui_points(1.2)])
        self._recording.log("force_depth/past", dots)
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
"""In the order of `text.LEVELS`."""
_LOG_LEVELS: Final = {"warning": "WARN", "ERROR": "ERROR"}

JOINT_COLORS: Final = (
    (230, 80, 80),
    (240, 150, 50),
    (220, 200, 60),
    (110, 190, 90),
    (70, 180, 200),
    (80, 120, 230),
    (170, 90, 220),
)
AWAITED: Final = (*(name for name, role in contract().roles.items() if not role.observer), "grant")
"""Possible causes of a wait: the services, and the conductor's grant of simulated time."""
DEPTH_FLOOR_M: Final = -0.02
"""The depth plot is blank further above the surface than this: free motion would flatten the contact to a line."""

Series = tuple[str, tuple[int, int, int]]


class Plots:
    """Draws plots, states and log."""

    def __init__(self, recording: rr.RecordingStream, columns: Columns, force_limit_n: float, legend: str, truth: str) -> None:
        """`force_limit_n`: working limit, drawn as a line; `legend` and `truth`: pages in Markdown."""
        self._recording = recording
        self._columns = columns
        self._limit = np.array([force_limit_n])
        self._states: dict[str, str] = {}
        self._texts: dict[str, str] = {}
        for name, page in (("legend", legend), ("truth", truth)):
            recording.log(f"text/{name}", rr.TextDocument(page, media_type=rr.MediaType.MARKDOWN), static=True)
        self._series("plots/force/measured", [("measured [N]", (255, 110, 110))])
        self._series("plots/force/true", [("true [N]", (150, 110, 240))])
        self._series("plots/force/limit", [("working limit [N]", (240, 200, 60))], width=1.0)
        self._series("plots/depth/measured", [("measured [mm]", (255, 170, 40))])
        self._series("plots/depth/setpoint", [("set-point [mm]", (230, 230, 230))], width=1.0)
        self._series("plots/depth/true", [("true [mm]", (150, 110, 240))])
        self._series("plots/truth/breath", [("true breath [mm]", (150, 110, 240))])
        self._series("plots/truth/moved", [("true motion of the umbilicus [mm]", (240, 200, 60))])
        self._series("plots/wall/displacement", [("followed [mm]", (255, 170, 40))])
        self._series("plots/wall/forecast", [("forecast 0.2 s before [mm]", (230, 230, 230))], width=1.0)
        names = [f"A{i + 1} [% of limit]" for i in range(7)]
        self._series("plots/torque/joints", list(zip(names, JOINT_COLORS, strict=True)))
        self._series("plots/speed/real_time_factor", [("real-time factor [1]", (70, 180, 200))])
        self._series("plots/waits/roles", list(zip(AWAITED, cycle((*JOINT_COLORS, (190, 190, 190))), strict=False)))
        self._series("plots/progress/targets", [("targets visited [%]", (70, 190, 90))])
        for path, states in (("state/phase", PHASES), ("state/driver", MODES)):
            shown = rr.StateConfiguration(values=[name for name, _ in states], colors=[color for _, color in states])
            recording.log(path, shown, static=True)
        self._health_lines: set[str] = set()

    def _series(self, path: str, series: Sequence[Series], width: float = 1.5) -> None:
        names = [name for name, _ in series]
        colors = [color for _, color in series]
        lines = rr.SeriesLines(names=names, colors=colors, widths=[width] * len(series))
        self._recording.log(path, lines, static=True)

    def _add(self, path: str, t: int, *values: float) -> None:
        self._columns.add(path, scalars, t, np.array(values, dtype=np.float64))

    def force(self, t: int, measured_n: float) -> None:
        """Plot the tared normal force and its working limit."""
        self._add("plots/force/measured", t, measured_n)
        self._columns.add("plots/force/limit", scalars, t, self._limit)

    def true_contact(self, t: int, depth_m: float, force_n: float) -> None:
        """Plot the true contact depth and force."""
        self._add("plots/force/true", t, force_n)
        self._add("plots/depth/true", t, 1e3 * depth_m if depth_m > DEPTH_FLOOR_M else np.nan)

    def true_patient(self, t: int, excursion_m: float, moved_m: float) -> None:
        """Plot the true breathing excursion and the displacement of the umbilicus from its initial position."""
        self._add("plots/truth/breath", t, 1e3 * excursion_m)
        self._add("plots/truth/moved", t, 1e3 * moved_m)

    def wall(self, t: int, displacement_m: float, forecast_m: float, ahead: int) -> None:
        """Plot the measured breathing displacement, and its forecast `ahead` [ns] later."""
        self._add("plots/wall/displacement", t, 1e3 * displacement_m)
        self._add("plots/wall/forecast", t + ahead, 1e3 * forecast_m)

    def depth(self, t: int, measured_m: float, setpoint_m: float) -> None:
        """Plot measured depth and set-point, along the inward normal from the perceived surface."""
        self._add("plots/depth/measured", t, 1e3 * measured_m if measured_m > DEPTH_FLOOR_M else np.nan)
        self._add("plots/depth/setpoint", t, 1e3 * setpoint_m if setpoint_m > DEPTH_FLOOR_M else np.nan)

    def torques(self, t: int, share: Array) -> None:
        """Plot applied torques over their limits [1], shape (7,)."""
        self._columns.add("plots/torque/joints", scalars, t, 100.0 * share)

    def progress(self, t: int, visited: int, total: int) -> None:
        """Plot the share of visited targets."""
        self._add("plots/progress/targets", t, 100.0 * visited / total if total else 0.0)

    def speed(self, t: int, real_time_factor: float) -> None:
        """Plot simulated over wall time during the last simulated second."""
        self._add("plots/speed/real_time_factor", t, real_time_factor)

    def waits(self, t: int, share: Array) -> None:
        """Plot the share of the observed waits caused by each of `AWAITED` [1], shape (k,)."""
        self._columns.add("plots/waits/roles", scalars, t, 100.0 * share)

    def state(self, t: int, path: str, name: str) -> bool:
        """Write a state when it changes; return True if it did."""
        if self._states.get(path) == name:
            return False
        self._states[path] = name
        self._at(t)
        self._recording.log(path, rr.StateChange(state=name))
        return True

    def health(self, t: int, row: Health) -> None:
        """Draw the health line of a service or topic, and log its message unless it is ok."""
        path = f"health/{'topics' if row.is_topic else 'services'}/{row.name}"
        if path not in self._health_lines:
            self._health_lines.add(path)
            shown = rr.StateConfiguration(values=list(LEVELS), colors=list(LEVEL_COLORS))
            self._recording.log(path, shown, static=True)
        self.state(t, path, row.word)
        if row.word in _LOG_LEVELS:
            self.log(t, f"log/{path}", row.message, _LOG_LEVELS[row.word])

    def log(self, t: int, path: str, text: str, level: str = "INFO") -> None:
        """Log a line unless it equals the previous one on this path."""
        if text and self._texts.get(path) != text:
            self._texts[path] = text
            self._at(t)
            self._recording.log(path, rr.TextLog(text, level=level))

    def document(self, t: int, path: str, markdown: str) -> None:
        """Write a page of text when it changes."""
        if self._texts.get(path) != markdown:
            self._texts[path] = markdown
            self._at(t)
            self._recording.log(path, rr.TextDocument(markdown, media_type=rr.MediaType.MARKDOWN))

    def _at(self, t: int) -> None:
        self._recording.set_time(TIMELINE, duration=np.timedelta64(t, "ns"))
