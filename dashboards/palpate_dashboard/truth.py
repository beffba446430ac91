"""What no sensor measures in a run, in Markdown: how the patient breathes and moves, and the errors that were drawn."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from palpate_models.numerics.frames import Array
from palpate_models.patient.breathing import BreathingCurve
from palpate_models.patient.motion import BodyMotion
from palpate_models.scenario.errors import DrawnErrors, draw_errors
from palpate_models.scenario.schema import Scenario


def page(scenario: Scenario) -> str:
    """The page on the truth behind a scenario that is simulated. Observers alone may see it."""
    drawn = draw_errors(scenario.errors, scenario.seed)
    rows = [*_patient(scenario), *_equipment(drawn)]
    return "\n".join((
        "**TRUTH, which none of those who examine knows.** What was drawn for this patient and simulated equipment, "
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
    """A small pose in two rows, translation and rotation vector: of the true frame in the nominal one."""
    turned = np.degrees(Rotation.from_matrix(X[:3, :3]).as_rotvec())
    return [(f"{name} [mm]", _triple(1e3 * X[:3, 3])), (f"{name} [degrees]", _triple(turned))]
