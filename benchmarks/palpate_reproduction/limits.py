"""What the paper says that its approach lacks or leaves open, and what became of each here, with figures of our runs."""

from __future__ import annotations

from dataclasses import dataclass

from palpate.report.rows import Report


@dataclass(frozen=True)
class Limit:
    """One limit of the paper."""

    paper: str
    """What the paper says."""
    here: str
    """What became of it."""
    shown: str
    """The figure of our runs or the place that shows it."""


def limits(report: Report, deformation_mm: float, peak_ratio: float) -> list[Limit]:
    """The table's rows, from the report of the default run.

    `deformation_mm`: greatest displacement of the skin in the pictures; `peak_ratio`: highest over median estimated stiffness.
    """
    scores, platform = report.scores, report.platform
    dice = "not known" if scores is None or scores.dice is None else f"{scores.dice:.2f}"
    off = "not known" if scores is None or scores.place_error_m is None else f"{1e3 * scores.place_error_m:.1f} mm"
    held = "not known" if scores is None or scores.coverage_90 is None else f"{100 * scores.coverage_90:.0f} %"
    depth = "not known" if report.depth_rms_error_m is None else f"{1e3 * report.depth_rms_error_m:.2f} mm"
    force = "not known" if report.max_force_N is None else f"{report.max_force_N:.1f} N"
    pace = f"{report.real_time_factor:.1f} × real time, {report.runtime} and recorded, {platform.get('cores')} cores"
    return [
        Limit(
            "DART has one stiffness a body: it is switched for the whole body while the tool is in the stiff area",
            "stiffness is a field over the surface: every vertex has its own, with a smooth edge",
            f"figure 8; one map holds stiffnesses up to {peak_ratio:.1f} times its median",
        ),
        Limit(
            "low real-time factor, from a soft body that is not optimal",
            "an explicit step with contact solved vertex by vertex, without a matrix to solve",
            pace,
        ),
        Limit(
            "the rigid part is the body scaled down: protruding parts displace the bone",
            "nothing is scaled: each vertex rests on a foundation along its own normal; or an elastic layer over a rigid back",
            "`phantom.kind=mesh` takes any mesh (quick start); `services.tissue=elastic`",
        ),
        Limit(
            "deformation is not shown",
            "the deformed surface is a topic: dashboard, camera and the pictures above show the same vertices",
            f"figure 6: the skin moves by up to {deformation_mm:.1f} mm",
        ),
        Limit(
            "no figure of how accurate the result is",
            "each run is scored against the truth, which only the tissue and the score know",
            f"localised within {off}, Dice {dice}, the 90 % band holds on {held}; `palpate study` over patients",
        ),
        Limit(
            "Gazebo's force sensor does not perceive the changes of stiffness; the force is read from inside the physics engine",
            "an F/T sensor under the tool, with bias, noise and the tool's weight; the examination knows nothing else",
            "the contract rejects a reader of `sim/` and `truth/` topics (docs/topics.md)",
        ),
        Limit(
            "the depth is that of the commanded pose: 10 mm along the normal, without regard to compliance",
            "measured depth is regulated; at the working force limit depth yields, and the sample says so",
            f"true depth {depth} RMS off its set-point, {force} at most",
        ),
        Limit(
            "scattered data, fitted by a script afterwards and projected onto a plane",
            "a map on the perceived surface in 3-D while the scan goes on, with its uncertainty, and findings with confidence",
            "figure 7, report.html of every run",
        ),
        Limit(
            "sources of Gazebo have to be changed and built",
            "wheels from a package index; `make run` on Python 3.11 to 3.13",
            "Makefile",
        ),
        Limit(
            "one model, one stiff area, one run",
            "scenarios, seeds, lesions anywhere, meshes of your own; equal hashes for equal runs",
            "`palpate scenarios`, docs/quick-start.md",
        ),
    ]
