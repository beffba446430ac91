"""What the status and services pages say, in markdown."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from palpate_bus.messages import ExamState, StiffnessMap
from palpate_bus.messages.codec import Message

LEVELS = ("ok", "warning", "ERROR", "stale")
"""diagnostic_msgs/DiagnosticStatus levels."""
SEVERITY = {"ok": 0, "stale": 1, "warning": 2, "ERROR": 3}
"""The order of these levels: the worst is shown first."""
CONTACT_FLAGS = ("in_contact", "steady", "force_limited", "view_blocked")
"""Fields of ExamState that are listed where they hold."""

FREE_M = -0.02
"""At this depth or less the tool is away from the skin, and what the force sensor reads is no contact but its bias."""
MUSCLE_TOLD = 0.05
"""From this probability on a tensed muscle is told beside a finding's confidence."""

LEGEND = """
| in the scene | |
|---|---|
| abdomen | skin where not scanned; then pale as the background, blue softer, red stiffer |
| blue line | planned path of the indenter |
| green, brown line | travelled path, free and in contact |
| red arrow beside the tool | measured normal force, 5 N are 15 cm |
| violet outline | true lesion at half contrast, on the patient's true pose: hidden until the eye of `world/truth` is clicked |
| white points | palpation targets; light blue: perceived points |
| pyramid | view of the depth camera, on its tripod |
| head, pillow, drape | for display only: neither arm nor camera meets them; switch them off under `world/patient` |

| elsewhere | |
|---|---|
| stiffness map | apparent stiffness over that of the background, seen from the front: the patient's right is on the left |
| uncertainty | half width of the 90 % band over the mean |
| force over depth | red: the last second; blue: all before; grey line: wanted depth |
| TRUTH: patient | what no sensor tells: how far the breath lifts the wall, and how far the patient has moved |
| joint torque | applied, gravity excluded, in percent of each joint's limit |
| health | a line each for every service, and for every topic as the contract's monitor sees it; why is in the log |
| waited for | of the waits seen since the start of the run, the part that each service was waited for |
| time | simulated |
"""


def status(scenario: str, phase: str, exam: ExamState, robot: str, real_time_factor: float | None) -> str:
    """The page on the state of the examination; `robot` is the driver's mode in words."""
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
    """One line of `diagnostics`: a service, or a topic as the contract's monitor sees it."""

    name: str
    level: int
    message: str
    values: Mapping[str, str]
    is_topic: bool = False

    @classmethod
    def of(cls, status: Message) -> Health:
        """From a diagnostic_msgs/DiagnosticStatus."""
        level = status.level if isinstance(status.level, int) else int.from_bytes(bytes(status.level), "little")
        values = {item.key: item.value for item in status.values}
        name = status.name.removeprefix("palpate/")
        return cls(name.removeprefix("topic/"), level, status.message, values, name.startswith("topic/"))

    @property
    def word(self) -> str:
        """The level in a word."""
        return LEVELS[self.level] if 0 <= self.level < len(LEVELS) else str(self.level)


def services(rows: Sequence[Health], waits: Iterable[tuple[str, float]] = ()) -> str:
    """Health of every service, then who was waited for, as parts [1], then every topic against its contract, the worst first."""
    lines = ["| service | state | | at | silent for |", "|---|---|---|---|---|"]
    for row in rows:
        if not row.is_topic:
            tick = f"{row.values['tick_s']} s" if "tick_s" in row.values else ""
            age = f"{row.values['report_age_s']} s" if "report_age_s" in row.values else ""
            lines.append(f"| {row.name} | {row.word} | {row.message} | {tick} | {age} |")
    waited = [f"{role} {100 * share:.0f} %" for role, share in waits if share > 0]
    if waited:
        lines += ["", f"**Waited for**: {', '.join(waited)}"]
    topics = sorted((row for row in rows if row.is_topic), key=lambda row: -SEVERITY[row.word])
    if topics:
        lines += ["", "| topic | state | | Hz, simulated | missing |", "|---|---|---|---|---|"]
    for row in topics:
        rate, missing = row.values.get("bus_rate_hz", ""), row.values.get("missing", "")
        lines.append(f"| {row.name} | {row.word} | {row.message} | {rate} | {missing if missing != '0' else ''} |")
    return "\n".join(lines)


UNASSESSED: Final = {
    StiffnessMap.CONTRADICTED: "the samples contradict each other",
    StiffnessMap.YIELDED: "the force limit was met before the depth",
}


def unassessed(codes: NDArray[np.uint8]) -> list[str]:
    """What of the places that were reached is not assessed, and why: a line for each reason that there is."""
    shares = {reason: float(np.mean(codes == code)) if len(codes) else 0.0 for code, reason in UNASSESSED.items()}
    return [f"not assessed: {100 * share:.0f} %, {reason}" for reason, share in shares.items() if share > 0]


def finding(f: Message) -> str:
    """A `palpation_msgs/Finding` in one line."""
    muscle = f" ({100 * f.guarding:.0f} % a tensed muscle)" if f.guarding >= MUSCLE_TOLD else ""
    return (
        f"{f.quadrant}: {f.ratio:.1f} x stiffer ({f.ratio_lower:.1f}-{f.ratio_upper:.1f}), {1e4 * f.area:.1f} cm2, "
        f"confidence {100 * f.confidence:.0f} %{muscle}"
    )
