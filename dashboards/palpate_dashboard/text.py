"""Text of the dashboard's pages, in Markdown: status, services, findings, and the truth of the simulation."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from palpate_bus.messages import ExamState, StiffnessMap
from palpate_bus.messages.codec import Message
from palpate_inputs import printable
from palpate_models.numerics.frames import Array
from palpate_models.patient.breathing import BreathingCurve
from palpate_models.patient.motion import BodyMotion
from palpate_models.scenario.errors import DrawnErrors, draw_errors
from palpate_models.scenario.schema import Scenario

LEVELS = ("ok", "warning", "ERROR", "stale")
"""diagnostic_msgs/DiagnosticStatus levels."""
SEVERITY = {"ok": 0, "stale": 1, "warning": 2, "ERROR": 3}
"""Sort order of the levels: the worst first."""
CONTACT_FLAGS = ("in_contact", "steady", "force_limited", "view_blocked")
"""Boolean fields of ExamState that the status page lists."""

FREE_M = -0.02
"""At a smaller depth the tool is off the skin, and the force reading is sensor bias."""
OTHERS_SHOWN = 0.05
"""Least probability of another cause that is shown with a finding."""

LEGEND = """
| in the scene | |
|---|---|
| abdomen | skin where not scanned; then pale as the background, blue softer, red stiffer |
| blue line | planned path of the indenter |
| green, brown line | travelled path, free and in contact |
| red arrow next to the tool | measured normal force, 5 N are 15 cm |
| violet outline | true lesion at half contrast, on the patient's true pose: hidden until the eye of `world/truth` is clicked |
| white points | palpation targets; light blue: perceived points |
| pyramid | view of the depth camera |

| elsewhere | |
|---|---|
| stiffness map | apparent stiffness over that of the background, seen from the front: the patient's right is on the left |
| uncertainty | half width of the 90 % band over the mean |
| force over depth | red: the last second; blue: all before; grey line: wanted depth |
| TRUTH: patient | breathing excursion and motion of the patient, from the simulation |
| joint torque | applied, gravity excluded, in percent of each joint's limit |
| health | one line per service and per topic, as checked against the contract; reasons are in the log |
| waited for | share of the waits since the start of the run that each service caused |
| time | simulated |
"""


def status(scenario: str, phase: str, exam: ExamState, robot: str, real_time_factor: float | None) -> str:
    """Return the status page; `robot`: text of the driver's mode."""
    flags = [name.replace("_", " ") for name in CONTACT_FLAGS if getattr(exam, name)]
    depth_mm = 1e3 * exam.depth
    speed = [] if real_time_factor is None else [f"| speed | {real_time_factor:.1f} x real time |"]
    depth = f"{depth_mm:.1f} mm" if exam.depth > FREE_M else "not in contact"
    return "\n".join((
        f"**{scenario}: {phase}.** {exam.message}",
        "",
        f"| targets | {exam.target_index} of {exam.target_count}, {exam.targets_skipped} skipped |",
        "|---|---|",
        f"| depth | {depth} |",
        f"| normal force | {exam.normal_force:.1f} N |",
        f"| contact | {', '.join(flags) or 'none'} |",
        f"| driver | {robot} |",
        *speed,
    ))  # fmt: skip


@dataclass(frozen=True)
class Health:
    """One entry of `diagnostics`: a service, or a topic as checked by the contract monitor."""

    name: str
    level: int
    message: str
    values: Mapping[str, str]
    is_topic: bool = False

    @classmethod
    def of(cls, status: Message) -> Health:
        """Return the entry of a diagnostic_msgs/DiagnosticStatus."""
        level = status.level if isinstance(status.level, int) else int.from_bytes(bytes(status.level), "little")
        values = {item.key: item.value for item in status.values}
        name = status.name.removeprefix("palpate/")
        return cls(name.removeprefix("topic/"), level, status.message, values, name.startswith("topic/"))

    @property
    def word(self) -> str:
        """Name of the level."""
        return LEVELS[self.level] if 0 <= self.level < len(LEVELS) else str(self.level)


def plain(text: str) -> str:
    """Return text for a cell of a table, without the characters of Markdown's links, images, code and HTML."""
    return re.sub(r"([\\`\[\]<>|!])", r"\\\1", printable(text).replace("\n", " "))


def services(rows: Sequence[Health], waits: Iterable[tuple[str, float]] = ()) -> str:
    """Return the services page: health of services, shares of waits [1], then topics, the worst first."""
    lines = ["| service | state | | at | silent for |", "|---|---|---|---|---|"]
    for row in rows:
        if not row.is_topic:
            tick = f"{row.values['tick_s']} s" if "tick_s" in row.values else ""
            age = f"{row.values['report_age_s']} s" if "report_age_s" in row.values else ""
            lines.append(f"| {row.name} | {row.word} | {plain(row.message)} | {tick} | {age} |")
    waited = [f"{role} {100 * share:.0f} %" for role, share in waits if share > 0]
    if waited:
        lines += ["", f"**Waited for**: {', '.join(waited)}"]
    topics = sorted((row for row in rows if row.is_topic), key=lambda row: -SEVERITY[row.word])
    if topics:
        lines += ["", "| topic | state | | Hz, simulated | missing |", "|---|---|---|---|---|"]
    for row in topics:
        rate, missing = row.values.get("bus_rate_hz", ""), row.values.get("missing", "")
        lines.append(f"| {row.name} | {row.word} | {plain(row.message)} | {rate} | {missing if missing != '0' else ''} |")
    return "\n".join(lines)


UNASSESSED: Final = {
    StiffnessMap.CONTRADICTED: "samples contradict each other",
    StiffnessMap.YIELDED: "force limit reached before the target depth",
}


def unassessed(codes: NDArray[np.uint8]) -> list[str]:
    """Return one line per reason for which reached places were not assessed."""
    shares = {reason: float(np.mean(codes == code)) if len(codes) else 0.0 for code, reason in UNASSESSED.items()}
    return [f"not assessed: {100 * share:.0f} %, {reason}" for reason, share in shares.items() if share > 0]


def finding(f: Message) -> str:
    """Return a `palpation_msgs/Finding` as one line."""
    causes = {"a tensed muscle": f.guarding, "a ridge": f.ridge, "bone": f.bone, "a soft defect": f.soft}
    others = "".join(f", {100 * p:.0f} % {name}" for name, p in causes.items() if p >= OTHERS_SHOWN)
    return (
        f"{f.quadrant}: {f.ratio:.1f} x stiffer ({f.ratio_lower:.1f}-{f.ratio_upper:.1f}), {1e4 * f.area:.1f} cm2, "
        f"confidence {100 * f.confidence:.0f} %{others}"
    )


def truth_page(scenario: Scenario) -> str:
    """Return the page with the simulation's ground truth. For observers only."""
    drawn = draw_errors(scenario.errors, scenario.seed)
    rows = [*_patient(scenario), *_equipment(drawn)]
    return "\n".join((
        "**TRUTH, unknown to the examining services.** Properties drawn for this patient and the simulated equipment "
        f"from seed {scenario.seed}.",
        "",
        "| | |",
        "|---|---|",
        *(f"| {name} | {value} |" for name, value in rows),
    ))  # fmt: skip


def _patient(scenario: Scenario) -> list[tuple[str, str]]:
    breathing, phantom = BreathingCurve(scenario.phantom.breathing, scenario.seed), scenario.phantom
    motion = BodyMotion(phantom.motion, scenario.seed)
    breaths = breathing.table
    breath = "none"
    if len(breaths):
        rate = 60 * len(breaths) / breathing.repeats_s
        breath = f"{phantom.breathing.kind}, {rate:.1f} a minute, {1e3 * breaths[:, 4].mean():.1f} mm, at most "
        breath += f"{1e3 * breathing.largest_m:.1f} mm"
    rows = [("breathing", breath)]
    if not motion.moves:
        return [*rows, ("motion", "none")]
    rows.append(("motion", f"{phantom.motion.kind} from {motion.at_s:.1f} s to {motion.until_s:.1f} s"))
    return [*rows, *_offset("moved", motion.pose(motion.until_s))]


def _equipment(drawn: DrawnErrors) -> list[tuple[str, str]]:
    force, camera, arm = drawn.force, drawn.camera, drawn.arm
    gain = 100 * (np.diag(force.sensitivity)[:3] - 1)
    return [
        ("force, bias", f"{_triple(force.bias[:3])} N"),
        ("force, when warm", f"{_triple(force.warm_up[:3])} N"),
        ("force, gain", f"{_triple(gain)} %"),
        ("camera, offset", f"{1e3 * camera.offset_m:+.1f} mm, {1e3 * camera.warm_up_m:+.1f} mm more when warm"),
        ("camera, largest bias", f"{1e3 * camera.given.field_m:.1f} mm, {len(camera.lost)} patches lost"),
        *_offset("camera, off by", drawn.X_CCt),
        *_offset("patient, off by", drawn.X_AAt),
        ("arm, largest joint offset", f"{1e3 * np.linalg.norm(arm.origin_m, axis=1).max():.2f} mm"),
        ("arm, largest joint zero", f"{1e3 * np.abs(arm.zero_rad).max():.2f} mrad"),
        ("arm, true over nominal friction", f"{arm.friction.min():.2f} to {arm.friction.max():.2f}"),
        ("tool, true over nominal mass", f"{arm.tool_mass:.3f}"),
    ]


def _triple(values: Array) -> str:
    return ", ".join(f"{value:+.2f}" for value in values)


def _offset(name: str, X: Array) -> list[tuple[str, str]]:
    """Return two rows: translation and rotation vector of the true frame in the nominal one."""
    turned = np.degrees(Rotation.from_matrix(X[:3, :3]).as_rotvec())
    return [(f"{name} [mm]", _triple(1e3 * X[:3, 3])), (f"{name} [degrees]", _triple(turned))]
