"""What the status and services pages say, in markdown."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

LEVELS = ("ok", "warning", "ERROR", "stale")
"""diagnostic_msgs/DiagnosticStatus levels."""

LEGEND = """
| in the scene | |
|---|---|
| abdomen | skin where not scanned; then pale as the background, blue softer, red stiffer |
| blue line | planned path of the indenter |
| green, brown line | travelled path, free and in contact |
| red arrow beside the tool | true normal force, 5 N are 15 cm |
| violet outline | true lesion at half contrast: switch it off under `world/truth` |
| white points | palpation targets; light blue: perceived points |
| pyramid | view of the depth camera, on its tripod |
| head, pillow, drape | for the eye alone: neither arm nor camera meets them; switch them off under `world/patient` |

| elsewhere | |
|---|---|
| stiffness map | stiffness over that of the background, seen from the front: the patient's right is on the left |
| uncertainty | half width of the 90 % band over the mean |
| force over depth | red: the last second; blue: all before; grey line: wanted depth |
| joint torque | applied, gravity excluded, in percent of each joint's limit |
| blame | of the waits seen since the start of the run, the part that each service was waited for |
| time | simulated |
"""


def status(
    scenario: str, phase: str, message: str, counts: tuple[int, int, int], depth_mm: float, force_n: float,
    flags: Sequence[str], robot: str, real_time_factor: float | None,
) -> str:  # fmt: skip
    """The state of the exam. `counts`: targets visited, in all, and skipped."""
    visited, total, skipped = counts
    pace = [] if real_time_factor is None else [f"| pace | {real_time_factor:.1f} x real time |"]
    depth = f"{depth_mm:.1f} mm" if depth_mm > -20 else "not in contact"
    return "\n".join((
        f"**{scenario}: {phase}.** {message}",
        "",
        f"| targets | {visited} of {total}, {skipped} skipped |",
        "|---|---|",
        f"| depth | {depth} |",
        f"| normal force | {force_n:.1f} N |",
        f"| contact | {', '.join(flags) or 'none'} |",
        f"| driver | {robot} |",
        *pace,
    ))  # fmt: skip


def services(rows: Iterable[tuple[str, int, str, Sequence[tuple[str, str]]]], blame: Iterable[tuple[str, float]] = ()) -> str:
    """Health of every service: name, level, message, and further values by key; then who was waited for, as parts [1]."""
    lines = ["| service | state | | at | silent for |", "|---|---|---|---|---|"]
    for name, level, message, values in rows:
        word = LEVELS[level] if 0 <= level < len(LEVELS) else str(level)
        known = dict(values)
        tick = f"{known['tick_s']} s" if "tick_s" in known else ""
        age = f"{known['report_age_s']} s" if "report_age_s" in known else ""
        lines.append(f"| {name.removeprefix('palpate/')} | {word} | {message} | {tick} | {age} |")
    waited = [f"{role} {100 * share:.0f} %" for role, share in blame if share > 0]
    if waited:
        lines += ["", f"**Waited for**: {', '.join(waited)}"]
    return "\n".join(lines)


def finding(quadrant: str, ratio: float, lower: float, upper: float, area_m2: float, confidence: float) -> str:
    """A finding in one line."""
    return (
        f"{quadrant}: {ratio:.1f} x stiffer ({lower:.1f}-{upper:.1f}), {1e4 * area_m2:.1f} cm2, "
        f"confidence {100 * confidence:.0f} %"
    )
