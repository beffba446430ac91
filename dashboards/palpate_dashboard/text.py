"""Text of the dashboard's pages, in Markdown: status, services, findings."""

import re
from collections.abc import Mapping, Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from palpate_bus.messages import ExamState, Message, StiffnessMap
from palpate_inputs import printable

LEVELS = ("ok", "warning", "ERROR", "stale")
"""diagnostic_msgs/DiagnosticStatus levels."""
SEVERITY = {"ok": 0, "stale": 1, "warning": 2, "ERROR": 3}
"""Sort order of the levels: the worst first."""
CONTACT_FLAGS = ("in_contact", "steady", "force_limited", "view_blocked")
"""Boolean fields of ExamState that the status page lists."""

FREE_M = -0.02
"""At a smaller depth the tool is off the skin, and the force reading is sensor bias."""
OTHERS_SHOWN = 0.05
"""Minimum probability of another cause that is shown with a finding."""

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
    depth = f"{depth_mm:.1f} mm" if exam.depth > FREE_M else "above the skin"
    return "\n".join((
        f"**{scenario}: {phase}.** {exam.message}",
        "",
        f"| target | {min(exam.target_index + 1, exam.target_count)} of {exam.target_count}, {exam.targets_skipped} skipped |",
        "|---|---|",
        f"| depth | {depth} |",
        f"| normal force | {exam.normal_force:.1f} N |",
        f"| contact | {', '.join(flags) or 'none'} |",
        f"| driver | {robot} |",
        *speed,
    ))  # fmt: skip


class Health(NamedTuple):
    """One entry of `diagnostics`: a service, or a topic as checked by the contract monitor."""

    name: str
    level: int
    message: str
    values: Mapping[str, str]
    is_topic: bool = False

    @classmethod
    def of(cls, status: Message) -> "Health":
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


def services(rows: Sequence[Health]) -> str:
    """Return the services page: health of services, then of topics, the worst first."""
    lines = ["| service | state | | at | silent for |", "|---|---|---|---|---|"]
    for row in rows:
        if not row.is_topic:
            tick = f"{row.values['tick_s']} s" if "tick_s" in row.values else ""
            age = f"{row.values['report_age_s']} s" if "report_age_s" in row.values else ""
            lines.append(f"| {row.name} | {row.word} | {plain(row.message)} | {tick} | {age} |")
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
