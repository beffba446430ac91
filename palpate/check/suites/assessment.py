"""Role assessment: the suite plays an examination of a belly with one stiff area, line by line, to its end."""

from typing import Any, NamedTuple

import numpy as np

from palpate.check import shapes
from palpate.check.rig import Rig, sense
from palpate.exam_state import exam_state
from palpate_bus.messages import MS, ExamState, header
from palpate_bus.messages.geometry import mesh_message, vectors
from palpate_models.numerics.frames import Array, apply
from palpate_models.scenario.load import exam_input

SAMPLES, MAP, FINDINGS = "assessment/samples", "assessment/map", "assessment/findings"


class Belly(NamedTuple):
    """A belly with one stiff area."""

    stiff_at_m: tuple[float, float] = (0.02, -0.015)
    stiff_radius_m: float = 0.022
    contrast: float = 3.0
    force_n: float = 3.0
    """Force at the depth of the scan on unremarkable tissue."""


class ScanSettings(NamedTuple):
    """The played scan and the wait for findings."""

    speed_mps: float = 0.03
    spacing_m: float = 0.0125
    answer_s: float = 30.0


BELLY, SCAN = Belly(), ScanSettings()


def stiffness(r: float) -> float:
    """Return the stiffness at a distance [m] from the middle of the stiff area, relative to unremarkable tissue."""
    return 1.0 + (BELLY.contrast - 1.0) / (1.0 + float(np.exp((r - BELLY.stiff_radius_m) / 0.004)))


class PlayedScan:
    """States of a raster scan of a square about the umbilicus, at 100 Hz; the force follows the local stiffness."""

    def __init__(self, X_WA: Array, depth: float, half: float, start: int) -> None:
        self._X_WA, self._depth, self._start = X_WA, depth, start
        line = np.arange(-half, half, SCAN.speed_mps * 0.01)
        rows = enumerate(np.arange(-half, half + 1e-9, SCAN.spacing_m))
        self.path = np.vstack([np.column_stack((line[::-1] if i % 2 else line, np.full(len(line), y))) for i, y in rows])
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
        depth = float(sense(self._depth, t)) if scanning else -0.01
        off = float(np.hypot(x - BELLY.stiff_at_m[0], y - BELLY.stiff_at_m[1]))
        force = BELLY.force_n * stiffness(off) if scanning else 0.0
        felt = {"depth_setpoint": self._depth, "depth": depth, "normal_force": force, "depth_uncertainty": 0.0005}
        return exam_state(t, phase, p_W, n_W, target_count=1, in_contact=scanning, steady=scanning, stroke=1, **felt)


def suite(rig: Rig) -> None:
    """Check silence before contact, samples, map and findings."""
    exam = rig.settings.scenario.exam
    half = min(0.05, exam.region_m[0] / 2, exam.region_m[1] / 2)
    X_WA = np.array(exam_input(rig.settings.scenario).X_WA)
    rig.section("before contact")
    vertices, normals, triangles = shapes.mesh(0.12, 0.006)
    surface = mesh_message(header(rig.t, "world"), apply(X_WA, vertices), normals @ X_WA[:3, :3].T, triangles)
    rig.send("perception/surface", surface)
    rig.run(0.2, {})
    rig.equal("finds nothing before contact", len(rig.log[SAMPLES]) + len(rig.log[FINDINGS]), 0)
    play = PlayedScan(X_WA, exam.depth_m, half, rig.t)
    rig.run(play.duration, {"exam/state": play.state})
    _samples(rig, half)
    _findings(rig, play)


def _samples(rig: Rig, half: float) -> None:
    rig.section("samples")
    received = [item.message for item in rig.log[SAMPLES]]
    if not rig.expect("takes samples", len(received) > 20, "many", len(received)):
        return
    p = vectors(m.position for m in received)
    off = np.max(np.abs(p[:, 2] - shapes.height(p[:, 0], p[:, 1])))
    rig.below("on the surface, in the abdomen frame", off, 0.003, "mm", 1e3)
    rig.below("where the indenter was", np.max(np.abs(p[:, :2])), half + 0.003, "mm", 1e3)
    force = [m.normal_force for m in received]
    rig.within("with the force that was measured", force, 0.5 * BELLY.force_n, 1.5 * BELLY.contrast * BELLY.force_n, "N")


def _findings(rig: Rig, play: PlayedScan) -> None:
    rig.section("findings")
    answer = rig.await_message(FINDINGS, SCAN.answer_s, {"exam/state": play.state})
    final = [item.message for item in answer if item.message.final]
    if not rig.equal("final findings once", len(final), 1):
        return
    found = final[0].findings
    rig.equal("finds the one stiff area", len(found), 1)
    if found:
        c = found[0].centroid
        rig.below("where it is", np.hypot(c.x - BELLY.stiff_at_m[0], c.y - BELLY.stiff_at_m[1]), 0.012, "mm", 1e3)
        rig.within("stiffer than its surroundings", found[0].ratio, 1.3, 2 * BELLY.contrast, "x")
        rig.within("with a band about its ratio", found[0].ratio, found[0].ratio_lower, found[0].ratio_upper, "x")
    last = rig.last(MAP)
    if rig.arrives("a map comes with them", last, "assessment/map"):
        n = len(last.vertices) // 3
        sizes = {n, len(last.apparent), len(last.lower), len(last.upper), len(last.force), len(last.scanned), len(last.finding)}
        rig.equal("one value per vertex", sizes, {n})
        ordered = bool(np.all(last.lower <= last.apparent)) and bool(np.all(last.apparent <= last.upper))
        rig.expect("bands include their value", ordered, "lower <= apparent <= upper")
        scanned, member = np.asarray(last.scanned, dtype=bool), np.asarray(last.finding) >= 0
        rest = float(np.median(last.apparent[scanned & ~member]))
        near = 0.5 * BELLY.force_n < rest < 2 * BELLY.force_n
        rig.expect("in newtons of the standard press", near, f"about {BELLY.force_n:g} N outside the findings", f"{rest:.2f} N")
