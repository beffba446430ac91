"""Checks and estimates of an examination before it starts: phantom, scan on the true body, services, duration, presses."""

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np

from palpate.apart import run_guarded
from palpate.run.roles import NONE, check_choices, settings_of
from palpate.truth.pressed import TrueBody, TrueSurface
from palpate_bus.messages.stamps import NS
from palpate_bus.settings import Settings
from palpate_conductor.collector import EXAM_LIMIT
from palpate_errors import UserError, restate
from palpate_models.numerics.frames import Array
from palpate_models.patient.mesh import MeshError
from palpate_models.patient.phantom import PhantomModel, build_phantom
from palpate_models.scenario.load import load_scenario
from palpate_models.scenario.patterns import Scan, Surface, scan_of, touch_centres
from palpate_models.scenario.schema import DEFAULT_ARM, PATTERN, Exam, Mode, Scenario
from palpate_plugins import PluginError, is_file


def scan_safely(exam: Exam, surface: Surface) -> Scan:
    """Return the scan of the examination's pattern; a user's pattern runs in a child process. Raises PluginError."""
    if not PATTERN.foreign(exam.pattern):
        return scan_of(exam, surface)
    part = f"exam.pattern = {exam.pattern!r}"
    return run_guarded(part, lambda: scan_of(exam, surface), Settings.read().start_limit_s, PluginError)


class ExamTiming(NamedTuple):
    """Durations in simulated time."""

    approach_and_return_s: float = 12.0
    """Before the first descent and after the last."""
    touch_s: float = 2.7
    line_change_s: float = 3.0
    """Lift, transfer, touch and press between two lines."""
    point_s: float = 2.8
    """One point of a point-wise scan."""
    searched_press_s: float = 4.0
    """One press of a search, which moves further."""
    transfer_mps: float = 0.17
    """Speed above the skin between two lines."""


TIMING = ExamTiming()


class Outlook(NamedTuple):
    """Expected duration, touches, lines and presses."""

    duration_s: float
    """Simulated time; of a search, an upper limit."""
    touches: int
    """Touches of the skin before the scan."""
    lines: int
    presses: int
    """Pressed targets; of a search, an upper limit."""

    @staticmethod
    def of(exam: Exam) -> "Outlook":
        """Return the estimates for an examination; the duration is a fit to examinations of several sizes."""
        scan = scan_safely(exam, _flat)
        touches = len(touch_centres(scan.targets))
        presses = exam.budget.presses if exam.searched else len(scan.targets)
        duration = TIMING.approach_and_return_s + TIMING.touch_s * touches + _pressing_s(exam, scan)
        return Outlook(duration, touches, len(scan.lines), presses)


def _pressing_s(exam: Exam, scan: Scan) -> float:
    if exam.searched:
        return min(TIMING.searched_press_s * exam.budget.presses, exam.budget.seconds)
    if exam.mode is Mode.POINT:
        return TIMING.point_s * len(scan.targets)
    slide = sum(_length(line) for line in scan.lines)
    between = sum(_length(np.vstack((a[-1], b[0]))) for a, b in pairwise(scan.lines))
    if scan.joined:
        return (slide + between) / exam.speed_mps + TIMING.line_change_s
    return slide / exam.speed_mps + between / TIMING.transfer_mps + TIMING.line_change_s * len(scan.lines)


def _length(points: Array) -> float:
    return float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())


def _flat(xy: Array) -> tuple[Array, Array]:
    """Return a flat surface: the length of a scan hardly depends on heights."""
    return np.column_stack((xy, np.zeros(len(xy)))), np.tile((0.0, 0.0, 1.0), (len(xy), 1))


def duration_text(seconds: float) -> str:
    """Return a duration as text: `40 s`, `3 min`."""
    return f"{seconds / 60:.0f} min" if seconds > 120 else f"{seconds:.0f} s"


def surface_of(phantom: PhantomModel) -> TrueSurface:
    """Return the front of a body at rest, in its own frame A."""
    return TrueSurface(TrueBody(phantom.vertices, phantom.triangles, np.eye(4)))


def scan_over(scenario: Scenario, phantom: PhantomModel) -> Scan:
    """Return the scan of the scenario's pattern. Raises PluginError for an unusable pattern or a region off the body."""
    surface = surface_of(phantom)
    scan = scan_safely(scenario.exam, surface.points)
    off = ~np.isfinite(surface.height(scan.targets))
    if off.any():
        exam = scenario.exam
        (left, feet), (right, head) = (edge(phantom.vertices[:, :2], axis=0) for edge in (np.min, np.max))
        x, y = scan.targets[off][0]
        raise PluginError(
            f"{scenario.name}: exam.region_m = {exam.region_m}, exam.centre_m = {exam.centre_m}: {off.sum()} of {len(off)} "
            f"targets lie off the body, the first at ({x:.3f}, {y:.3f}) m; the body reaches from x = {left:.2f} to {right:.2f} m "
            f"and from y = {feet:.2f} to {head:.2f} m"
        )
    return scan


def check_usable(
    name: str,
    settings: Sequence[str] | None = None,
    seed: int | None = None,
    services: Sequence[str] | None = None,
    elsewhere: bool = False,
) -> Scenario:
    """Return a scenario whose phantom can be made and whose services exist. Raises UserError for any other.

    `services`: choices ROLE=NAME_OR_FILE. With `elsewhere` the services run in containers or on other machines, and they and the
    arm are not checked here.
    """
    with restate(MeshError, UserError, name):
        return check_examinable(load_scenario(name, [*(settings or ()), *settings_of(services or ())], seed), elsewhere)


def check_examinable(scenario: Scenario, elsewhere: bool = False) -> Scenario:
    """Return the scenario after its phantom, its scan and, unless they run `elsewhere`, its arm and services were checked.

    Raises MeshError for the phantom, PluginError for a scan that leaves the body and for a missing service, UserError for an arm
    and for a scan that takes too long.
    """
    if is_file(pattern := scenario.exam.pattern):  # services have other working directories
        exam = scenario.exam.model_copy(update={"pattern": str(Path(pattern).resolve())})
        scenario = scenario.model_copy(update={"exam": exam})
    if scenario.services.tissue != NONE:
        scan_over(scenario, build_phantom(scenario.phantom, scenario.seed))
        if scenario.robot.arm != DEFAULT_ARM and not elsewhere:
            from palpate.run.clearance import check_clear  # noqa: PLC0415 - it imports pinocchio

            check_clear(scenario)
    if (needed_s := Outlook.of(scenario.exam).duration_s) > EXAM_LIMIT / NS:
        text = f"the examination takes {needed_s:.0f} s of simulated time, and {EXAM_LIMIT / NS:.0f} s is the limit"
        raise UserError(f"{scenario.name}: {text}; reduce exam.region_m or the presses, or increase exam.spacing_m")
    return scenario if elsewhere else check_choices(scenario)
