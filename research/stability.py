"""Delay margins of the contact of robot, tissue and controller: measured, and by linear theory."""

from dataclasses import dataclass
from pathlib import Path

from matplotlib.figure import Figure

from palpate.console import wide_console
from palpate_validation.check import COLOURS, QUIET, Check, PageSection, table, write
from research.contact_rig import CONTACT_PATH, CONTROL_PATH, EVENTS, Delays, Ringing, press
from research.loop_theory import linearise

STIFFNESS_NPM = 5000.0
"""K_z of an examination."""
SOFTER_NPM = (2500.0, 1000.0)
"""Others, on the default wall."""
CONTRASTS = (1.0, 4.0, 10.0)
DELAYS_MS = (0, 2, 4, 6, 8, 10)
PATHS = {"all": EVENTS, "control": CONTROL_PATH, "contact": CONTACT_PATH}
AGREE_MS = 3
"""Tolerance between measured margin and theory [ms]: near the margin ringing decays more slowly than the run lasts."""
WORDS = {"all": "all messages late", "control": "controller and robot", "contact": "robot and tissue"}
LARGEST_MS = 24
"""Margins are sought up to here."""


@dataclass(frozen=True)
class Margin:
    """Largest delay of each message with which the contact stays quiet."""

    path: str
    contrast: float
    stiffness: float
    """K_z of the controller [N/m]."""
    measured_ms: int
    """-1: not even without delay."""
    theory_ms: int


@dataclass(frozen=True)
class Stability:
    """All that was measured."""

    delay: dict[float, list[Ringing]]
    """Ringing by contrast, one for each of `DELAYS_MS`, on all messages."""
    jitter: dict[float, list[Ringing]]
    """Ringing with jitter from zero to the given milliseconds."""
    margins: list[Margin]
    soft_across_ms: int
    """Theory's margin of the control path with a quarter of the stiffness across the tool, default wall."""


def margin_ms(contrast: float, topics: tuple[str, ...], stiffness: float = STIFFNESS_NPM) -> int:
    """Largest whole delay [ms] of each message of `topics` with which the contact stays quiet, by bisection up to 24 ms."""
    if press(contrast, stiffness, Delays(topics, LARGEST_MS * 1e-3)).stable:
        return LARGEST_MS
    low, high = -1, LARGEST_MS  # low: quiet, high: not
    while high - low > 1:
        middle = (low + high) // 2
        if press(contrast, stiffness, Delays(topics, middle * 1e-3)).stable:
            low = middle
        else:
            high = middle
    return low


def measure() -> Stability:
    """Return the sweeps, and margins of each path for each contrast."""
    delay = {c: [press(c, STIFFNESS_NPM, Delays(EVENTS, ms * 1e-3)) for ms in DELAYS_MS] for c in CONTRASTS}
    jitter = {c: [press(c, STIFFNESS_NPM, Delays(EVENTS, 0.0, ms * 1e-3)) for ms in DELAYS_MS] for c in CONTRASTS}
    margins = []
    for contrast in CONTRASTS:
        loop = linearise(contrast, STIFFNESS_NPM)
        for path, topics in PATHS.items():
            margins.append(Margin(path, contrast, STIFFNESS_NPM, margin_ms(contrast, topics), loop.margin_ms(topics)))
    for stiffness in SOFTER_NPM:
        theory = linearise(1.0, stiffness).margin_ms(CONTROL_PATH)
        margins.append(Margin("control", 1.0, stiffness, margin_ms(1.0, CONTROL_PATH, stiffness), theory))
    return Stability(delay, jitter, margins, linearise(1.0, STIFFNESS_NPM, 0.25).margin_ms(CONTROL_PATH))


def section(found: Stability | None = None) -> PageSection:
    """Sweep and margins with their bounds."""
    found = found or measure()
    checks = []
    for margin in found.margins:
        name = f"x{margin.contrast:g} wall, K_z = {margin.stiffness:g} N/m, {WORDS[margin.path]}: quiet up to"
        low, high = margin.theory_ms - AGREE_MS, margin.theory_ms + AGREE_MS
        tried_all = margin.theory_ms >= LARGEST_MS
        against = f"theory: {margin.theory_ms}" + (" or more" if tried_all else "")
        checks.append(Check(name, margin.measured_ms, "ms a message", low, None if tried_all else high, against))
    late = {m.contrast: m.measured_ms for m in found.margins if m.path == "all"}
    for contrast in CONTRASTS:
        quiet = [ms for ms, ringing in zip(DELAYS_MS, found.jitter[contrast], strict=True) if ringing.stable]
        checks.append(
            Check(f"x{contrast:g} wall: quiet with jitter up to", max(quiet), "ms", late[contrast], against="all messages late")
        )
    control = [m.measured_ms for m in found.margins if m.path == "control" and m.stiffness == STIFFNESS_NPM]
    contact = [m.measured_ms for m in found.margins if m.path == "contact"]
    softest = next(m.measured_ms for m in found.margins if m.stiffness == SOFTER_NPM[-1])
    text = (
        "Robot, tissue and controller as a run has them (K_z = 5000 N/m), pressed 10 mm deep in the posture of an examination; "
        "the set-point is nudged by 0.5 mm and the force must be quiet half a second later. Every message of the named topics "
        "is late by the same time, so a loop of two messages by twice that, on top of the millisecond that a tick costs. The "
        f"path between controller and robot bears {min(control)} to {max(control)} ms a message, whatever the wall, and "
        f"{softest} ms "
        f"with K_z = {SOFTER_NPM[-1]:g} N/m: it is not the contact that turns over but the controller's spring across the tool, "
        f"for with a quarter of its 3000 N/m theory gives {found.soft_across_ms} ms. "
        f"The path between robot and tissue, which hardware does not have, bears {min(contact)} ms at least ({LARGEST_MS} were "
        "tried). Jitter delays a message by half of its maximum in the mean, so more of it is borne than of delay. Theory: the "
        "arm's seven joints, linearised, by Nyquist's criterion. Beyond the margin a ring grows until the driver "
        "holds (crosses)."
    )
    return PageSection(
        "stability", "Contact under bus delay and jitter", text, tuple(checks), lambda f: draw(f, found), (7.0, 4.6)
    )


def draw(figure: Figure, found: Stability) -> None:
    """Ringing against delay and jitter, and the force over time on either side of the margin."""
    axes = figure.subplots(2, 2)
    for sweep, ax, label in ((found.delay, axes[0, 0], "delay of every message [ms]"), (found.jitter, axes[0, 1], "jitter [ms]")):
        for contrast, colour in zip(CONTRASTS, COLOURS, strict=False):
            swing = [max(100 * r.swing / max(r.mean_force, 0.1), 1e-2) for r in sweep[contrast]]
            ax.plot(DELAYS_MS, swing, "o-", color=colour, ms=3, lw=1, label=f"wall x{contrast:g}")
            held = [(ms, s) for ms, s, r in zip(DELAYS_MS, swing, sweep[contrast], strict=True) if r.held]
            ax.plot([ms for ms, _ in held], [s for _, s in held], "x", color=colour, ms=7)
        ax.axhline(5, color=QUIET, lw=0.8, ls="--")
        ax.set(xlabel=label, ylabel="swing [% of the force]", yscale="log")
        ax.legend()
    for contrast, ax in ((CONTRASTS[0], axes[1, 0]), (CONTRASTS[-1], axes[1, 1])):
        for k in (0, 3, 5):
            ringing = found.delay[contrast][k]
            colour, label = COLOURS[k // 2], f"delay {DELAYS_MS[k]} ms"
            ax.plot(ringing.time, ringing.force, color=colour, lw=0.8, zorder=-k, label=label)
        ax.set(xlabel="time [s]", ylabel=f"force, wall x{contrast:g} [N]", xlim=(0.0, None))
        ax.legend()


if __name__ == "__main__":
    found = section()
    write([found], Path("out/research"))
    wide_console(150).print(table([found]), found.text)
