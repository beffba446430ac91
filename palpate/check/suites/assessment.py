"""Role assessment: the suite plays an examination of a belly with one stiff area, line by line, to its end."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from palpate.check import shapes
from palpate.check.report import ConformanceReport
from palpate.check.rig import Rig
from palpate.exam_state import exam_state
from palpate_bus.contract import MS
from palpate_bus.messages import ExamState, SurfaceMesh
from palpate_bus.messages.stamps import header
from palpate_models.numerics.frames import Array, apply
from palpate_models.scenario.load import exam_input

SAMPLES, MAP, FINDINGS = "assessment/samples", "assessment/map", "assessment/findings"


@dataclass(frozen=True)
class Belly:
    """A belly with one stiff area."""

    stiff_at_m: tuple[float, float] = (0.02, -0.015)
    stiff_radius_m: float = 0.022
    contrast: float = 3.0
    force_n: float = 3.0
    """Force at the depth of the scan on unremarkable tissue."""


@dataclass(frozen=True)
class ScanSettings:
    """The played scan and the wait for findings."""

    speed_mps: float = 0.03
    spacing_m: float = 0.0125
    answer_s: float = 30.0


BELLY, SCAN = Belly(), ScanSettings()


class PlayedScan:
    """States of a raster scan of a square about the umbilicus, at 100 Hz; the force follows the local stiffness."""

    def __init__(self, X_WA: Array, depth: float, half: float, start: int) -> None:
        self._X_WA, self._depth, self._start = X_WA, depth, start
        line = np.arange(-half, half, SCAN.speed_mps * 0.01)
        rows = []
        for i, y in enumerate(np.arange(-half, half + 1e-9, SCAN.spacing_m)):
            rows.append(np.column_stack((line if i % 2 == 0 else line[::-1], np.full(len(line), y))))
        self.path = np.vstack(rows)
        self.duration = len(self.path) * 0.01 + 1.0

    def state(self, t: int) -> Any:
        """Return the state at `t` [ns]."""
        i = (t - self._start) // (10 * MS) - 50
        phase = ExamState.PHASE_INDENT if i < 0 else ExamState.PHASE_SCAN if i < len(self.path) else ExamState.PHASE_ASSESS
        x, y = self.path[int(np.clip(i, 0, len(self.path) - 1))]
        scanning = phase == ExamState.PHASE_SCAN
        p_A = np.array([[x, y, shapes.height(np.array(x), np.array(y))]])
        n_A = shapes.normals(np.array([x]), np.array([y]))
        p_W, n_W = apply(self._X_WA, p_A)[0], (n_A @ self._X_WA[:3, :3].T)[0]
        depth = self._depth if scanning else -0.01
        force = BELLY.force_n * self.stiffness(x, y) if scanning else 0.0
        return exam_state(
            t,
            phase,
            p_W,
            n_W,
            target_count=1,
            in_contact=scanning,
            steady=scanning,
            depth_setpoint=self._depth,
            depth=depth,
            normal_force=force,
            depth_uncertainty=0.0005,
            stroke=1,
        )

    @staticmethod
    def stiffness(x: float, y: float) -> float:
        """Return the stiffness relative to unremarkable tissue."""
        r = float(np.hypot(x - BELLY.stiff_at_m[0], y - BELLY.stiff_at_m[1]))
        return 1.0 + (BELLY.contrast - 1.0) / (1.0 + float(np.exp((r - BELLY.stiff_radius_m) / 0.004)))


def suite(rig: Rig, report: ConformanceReport) -> None:
    """Check silence before contact, samples, map and findings."""
    exam = rig.settings.scenario.exam
    half = min(0.05, exam.region_m[0] / 2, exam.region_m[1] / 2)
    X_WA = np.array(exam_input(rig.settings.scenario).X_WA)
    report.section("before contact")
    vertices, normals, triangles = shapes.mesh(0.12, 0.006)
    flat = (apply(X_WA, vertices).astype(np.float32).ravel(), (normals @ X_WA[:3, :3].T).astype(np.float32).ravel())
    rig.send(
        "perception/surface",
        SurfaceMesh(header(rig.t, "world"), *flat, triangles.astype(np.uint32).ravel(), np.empty(0, np.float32)),
    )
    rig.run(0.2, {})
    quiet = len(rig.log[SAMPLES]) + len(rig.log[FINDINGS])
    report.expect("finds nothing before contact", quiet == 0, "no samples, no findings", quiet)
    play = PlayedScan(X_WA, exam.depth_m, half, rig.t)
    rig.run(play.duration, {"exam/state": play.state})
    _samples(rig, half, report)
    _findings(rig, play, report)


def _samples(rig: Rig, half: float, report: ConformanceReport) -> None:
    report.section("samples")
    received = [item.message for item in rig.log[SAMPLES]]
    if not report.expect("takes samples", len(received) > 20, "many", len(received)):
        return
    p = np.array([(m.position.x, m.position.y, m.position.z) for m in received])
    off = float(np.max(np.abs(p[:, 2] - shapes.height(p[:, 0], p[:, 1]))))
    report.expect("on the surface, in the abdomen frame", off < 0.003, "within 3 mm", f"{off * 1e3:.2f} mm")
    inside = float(np.max(np.abs(p[:, :2]))) <= half + 0.003
    report.expect(
        "where the indenter was", inside, f"within {half * 1e3:.0f} mm of the umbilicus", np.abs(p[:, :2]).max(axis=0).round(3)
    )
    force = np.array([m.normal_force for m in received])
    ok = bool(np.all((force > 0.5 * BELLY.force_n) & (force < 1.5 * BELLY.contrast * BELLY.force_n)))
    report.expect(
        "with the force that was measured",
        ok,
        f"{BELLY.force_n} to {BELLY.contrast * BELLY.force_n} N",
        f"{force.min():.2f} to {force.max():.2f} N",
    )


def _findings(rig: Rig, play: PlayedScan, report: ConformanceReport) -> None:
    report.section("findings")
    waited = 0.0
    while not rig.log[FINDINGS] and waited < SCAN.answer_s:
        rig.run(0.5, {"exam/state": play.state})
        waited += 0.5
    final = [item.message for item in rig.log[FINDINGS] if item.message.final]
    if not report.expect("final findings once", len(final) == 1, 1, len(final)):
        return
    found = final[0].findings
    report.expect("finds the one stiff area", len(found) == 1, "1 finding", len(found))
    if found:
        c = found[0].centroid
        off = float(np.hypot(c.x - BELLY.stiff_at_m[0], c.y - BELLY.stiff_at_m[1]))
        report.expect("where it is", off < 0.012, "within 12 mm", f"{off * 1e3:.1f} mm")
        ratio = found[0].ratio
        report.expect(
            "stiffer than its surroundings", 1.3 < ratio < 2 * BELLY.contrast, f"up to {BELLY.contrast:g} x", f"{ratio:.2f} x"
        )
        band = found[0].ratio_lower <= ratio <= found[0].ratio_upper
        report.expect(
            "with a band about its ratio",
            band,
            "lower <= ratio <= upper",
            f"{found[0].ratio_lower:.2f} to {found[0].ratio_upper:.2f}",
        )
    last = rig.last(MAP)
    if report.expect("a map comes with them", last is not None, "assessment/map", "there" if last is not None else "none"):
        n = len(last.vertices) // 3
        sizes = {n, len(last.apparent), len(last.lower), len(last.upper), len(last.force), len(last.scanned), len(last.finding)}
        report.expect("one value per vertex", sizes == {n}, n, sorted(sizes))
        ordered = bool(np.all(last.lower <= last.apparent)) and bool(np.all(last.apparent <= last.upper))
        report.expect("bands include their value", ordered, "lower <= apparent <= upper")
        scanned, member = np.asarray(last.scanned, dtype=bool), np.asarray(last.finding) >= 0
        rest = float(np.median(last.apparent[scanned & ~member]))
        near = 0.5 * BELLY.force_n < rest < 2 * BELLY.force_n
        report.expect(
            "in newtons of the standard press", near, f"about {BELLY.force_n:g} N outside the findings", f"{rest:.2f} N"
        )
