"""The curves and words beside the scene: force, depth, torque, speed, phase, log. Numbers in, rerun entities out."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import cycle
from typing import Final

import numpy as np
import rerun as rr

from palpate_bus.contract import contract
from palpate_dashboard.columns import TIMELINE, Columns, scalars
from palpate_dashboard.words import LEVELS, Health
from palpate_models.numerics.frames import Array

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
"""Phases of the exam by number (ExamState.PHASE_*), with a colour each."""

MODES: Final = (("idle", (120, 130, 145)), ("active", (70, 190, 90)), ("safe hold", (220, 40, 40)))
"""Driver modes by number (RobotStatus.MODE_*)."""

LEVEL_COLORS: Final = ((70, 190, 90), (240, 200, 60), (220, 40, 40), (120, 130, 145))
"""In the order of `words.LEVELS`."""
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
"""Who can be waited for: the services, and the conductor's grant of simulated time."""
DEPTH_FLOOR_M: Final = -0.02
"""Above the surface by more than this the depth curve pauses: free motion would flatten the contact to a line."""

Series = tuple[str, tuple[int, int, int]]


class Plots:
    """Draws the curves and words into a recording."""

    def __init__(self, recording: rr.RecordingStream, columns: Columns, force_limit_n: float, legend: str, truth: str) -> None:
        """`force_limit_n`: the working limit [N], drawn as a line; `legend` and `truth`: pages in markdown."""
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
        """The tared normal force, with the limit it must keep."""
        self._add("plots/force/measured", t, measured_n)
        self._columns.add("plots/force/limit", scalars, t, self._limit)

    def true_contact(self, t: int, depth_m: float, force_n: float) -> None:
        """What the simulation knows of the contact."""
        self._add("plots/force/true", t, force_n)
        self._add("plots/depth/true", t, 1e3 * depth_m if depth_m > DEPTH_FLOOR_M else np.nan)

    def true_patient(self, t: int, excursion_m: float, moved_m: float) -> None:
        """How far the breath has lifted the wall, and how far the umbilicus is from where the patient lay first."""
        self._add("plots/truth/breath", t, 1e3 * excursion_m)
        self._add("plots/truth/moved", t, 1e3 * moved_m)

    def wall(self, t: int, displacement_m: float, forecast_m: float, ahead: int) -> None:
        """How far breathing lifts the wall by the camera, and how far it is forecast to be lifted `ahead` [ns] later."""
        self._add("plots/wall/displacement", t, 1e3 * displacement_m)
        self._add("plots/wall/forecast", t + ahead, 1e3 * forecast_m)

    def depth(self, t: int, measured_m: float, setpoint_m: float) -> None:
        """Measured depth and its set-point, along the inward normal from the perceived surface."""
        self._add("plots/depth/measured", t, 1e3 * measured_m if measured_m > DEPTH_FLOOR_M else np.nan)
        self._add("plots/depth/setpoint", t, 1e3 * setpoint_m if setpoint_m > DEPTH_FLOOR_M else np.nan)

    def torques(self, t: int, share: Array) -> None:
        """Applied torques over their limits [1], shape (7,)."""
        self._columns.add("plots/torque/joints", scalars, t, 100.0 * share)

    def progress(self, t: int, visited: int, total: int) -> None:
        """How many of the targets are done."""
        self._add("plots/progress/targets", t, 100.0 * visited / total if total else 0.0)

    def speed(self, t: int, real_time_factor: float) -> None:
        """Simulated over wall time, over the last simulated second."""
        self._add("plots/speed/real_time_factor", t, real_time_factor)

    def waits(self, t: int, share: Array) -> None:
        """The part [1] of the observed waits that each of `AWAITED` was waited for, shape (k,)."""
        self._columns.add("plots/waits/roles", scalars, t, 100.0 * share)

    def state(self, t: int, path: str, name: str) -> bool:
        """A state, written when it changes; returns whether it did."""
        if self._states.get(path) == name:
            return False
        self._states[path] = name
        self._at(t)
        self._recording.log(path, rr.StateChange(state=name))
        return True

    def health(self, t: int, row: Health) -> None:
        """The line of a service or topic, coloured by its level, and in the log what is wrong with it."""
        path = f"health/{'topics' if row.is_topic else 'services'}/{row.name}"
        if path not in self._health_lines:
            self._health_lines.add(path)
            shown = rr.StateConfiguration(values=list(LEVELS), colors=list(LEVEL_COLORS))
            self._recording.log(path, shown, static=True)
        self.state(t, path, row.word)
        if row.word in _LOG_LEVELS:
            self.say(t, f"log/{path}", row.message, _LOG_LEVELS[row.word])

    def say(self, t: int, path: str, text: str, level: str = "INFO") -> None:
        """A line of the log, written when it differs from the one before on this path."""
        if text and self._texts.get(path) != text:
            self._texts[path] = text
            self._at(t)
            self._recording.log(path, rr.TextLog(text, level=level))

    def document(self, t: int, path: str, markdown: str) -> None:
        """A page of text, written when it changes."""
        if self._texts.get(path) != markdown:
            self._texts[path] = markdown
            self._at(t)
            self._recording.log(path, rr.TextDocument(markdown, media_type=rr.MediaType.MARKDOWN))

    def _at(self, t: int) -> None:
        self._recording.set_time(TIMELINE, duration=np.timedelta64(t, "ns"))
