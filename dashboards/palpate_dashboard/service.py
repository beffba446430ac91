"""Dashboard service: takes the latest message of every observed topic and draws what changed.

It sends nothing, so it cannot change a run. Late messages are skipped.
"""

from collections.abc import Callable, Mapping
from pathlib import Path
from time import perf_counter
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from palpate_bus.contract import contract
from palpate_bus.messages import MS, Message, RobotStatus, StiffnessMap, SurfaceMotion, nanoseconds
from palpate_bus.messages.geometry import pose_matrix, vectors
from palpate_bus.runs.run_folder import run_of
from palpate_bus.service import Inbox, Outbox, Service
from palpate_bus.settings import Settings
from palpate_dashboard import plots, text
from palpate_dashboard.layout import blueprint
from palpate_dashboard.plots import ForceDepth, ForceDepthPlane, Plots, depth_mm
from palpate_dashboard.scene import MapView, SceneView
from palpate_dashboard.sinks import Canvas, Live, open_recording
from palpate_models.numerics.frames import apply
from palpate_models.numerics.maps import half_width, level_lines
from palpate_models.patient.mesh import vertex_normals
from palpate_models.robot.arm import arm_of
from palpate_models.scenario.load import exam_input
from palpate_models.scenario.schema import Scenario

FILE: Final = "recording.rrd"


class ViewPeriods(NamedTuple):
    """Periods of what is drawn [ns], simulated."""

    mesh_ns: int = 100 * MS
    plot_ns: int = 50 * MS
    text_ns: int = 500 * MS
    image_ns: int = 500 * MS
    map_ns: int = 1000 * MS
    sparse_ns: int = 2000 * MS
    """Period of meshes and images in a sparse recording."""
    pose_ns: int = 100 * MS
    """Period of link poses in a sparse recording."""
    send_ns: int = 1000 * MS
    """Simulated time per chunk of the file."""
    send_live_ns: int = 200 * MS
    """Simulated time per chunk with a live viewer."""


PERIODS = ViewPeriods()
FORECAST_INDEX: Final = 4
"""The drawn forecast of the breathing motion: 0.2 s ahead, about what planning uses."""
ABOVE_SKIN_M: Final = 0.002
"""Height of outlines above the surface."""


class DashboardService(Service):
    """Draws a run into the file `path`, and into a viewer as given by `live`."""

    role = "dashboard"

    def __init__(self, scenario: Scenario, path: Path | None, live: Live, *, paced: bool = True, full: bool = True) -> None:
        """The truth in `scenario` is not used. `paced`: show the real-time factor.

        Without a `path` no file is written. Unless `full`, meshes and images are sparse while no viewer is connected.

        Raises OSError if `path` is not writable.
        """
        given = exam_input(scenario)
        self._torque_nm = arm_of(given.robot).torque_nm
        self._name = scenario.name
        self._path = path
        self._X_WA = np.array(given.X_WA)
        exam, self._limit_n = given.exam, given.limits.force_working_n
        plane = ForceDepthPlane(exam.depth_m, self._limit_n)
        layout = blueprint(exam.region_m, exam.centre_m, exam.depth_m, plane.bounds)
        run = "" if path is None else run_of(path.parent)
        self._canvas = Canvas(open_recording(path, live, layout, scenario.name, run))
        self._force_depth = ForceDepth(self._canvas, plane)
        self._send_period = PERIODS.send_live_ns if paced and live != Live() else PERIODS.send_ns
        self._scene = scene = SceneView(self._canvas, given.robot, given.camera)
        self._map = MapView(self._canvas, exam.region_m, exam.centre_m)
        self._plots = Plots(self._canvas, text.LEGEND)
        self._waits = np.zeros(len(plots.AWAITED))
        self._producers = {topic.name: topic.producer for topic in contract().topics.values()}
        self._seen: dict[str, Message] = {}
        self._due: dict[str, int] = {}
        self._in_contact = False
        self._X_WA_initial: NDArray[np.float64] | None = None
        """True pose of the patient before any motion, shape (4, 4)."""
        self._pressed_n = 0.0
        self._found: list[str] = []
        self._unassessed: list[str] = []
        self._robot = "no status yet"
        self._shows_speed = paced
        self._speed: float | None = None
        self._speed_mark = (0, perf_counter())
        self._steps = 0
        self._busy_s = 0.0
        often = full or live != Live()
        self._drawing: tuple[tuple[str, int, Callable[[int, Message], None]], ...] = (
            ("sim/surface", PERIODS.mesh_ns if often else PERIODS.sparse_ns, scene.abdomen),
            ("truth/phantom", 0, self._phantom),
            ("tf_static", 0, scene.camera),
            ("camera/depth/camera_info", PERIODS.image_ns, scene.lens),
            ("camera/depth/image_raw", PERIODS.image_ns if often else PERIODS.sparse_ns, scene.depth),
            ("perception/points", PERIODS.image_ns, scene.cloud),
            ("perception/surface", PERIODS.image_ns, scene.perceived),
            ("perception/targets", 0, self._targets),
            ("perception/motion", PERIODS.plot_ns, self._wall),
            ("planning/path", 0, scene.planned),
            ("exam/state", PERIODS.plot_ns, self._exam),
            ("truth/indentation", PERIODS.plot_ns, self._indentation),
            ("truth/patient", PERIODS.plot_ns, self._patient),
            ("sim/link_poses", PERIODS.plot_ns if often else PERIODS.pose_ns, self._link_poses),
            ("robot/status", PERIODS.plot_ns, self._robot_status),
            ("assessment/map", PERIODS.map_ns, self._stiffness),
            ("assessment/findings", 0, self._findings),
            ("diagnostics", PERIODS.text_ns, self._diagnostics),
        )

    def step(self, t: int, inbox: Inbox) -> Outbox:
        """Draw new messages that are due at `t` [ns]. Returns an empty outbox."""
        start = perf_counter()
        for topic, period, draw in self._drawing:
            if inbox.stamp(topic) is not None and self._is_due(topic, t, period):
                message = inbox.latest(topic)
                if message is not None and message is not self._seen.get(topic):
                    self._seen[topic] = message
                    self._due[topic] = t + period
                    draw(t, message)
        if self._shows_speed and self._is_due("speed", t, 1000 * MS):
            self._due["speed"] = t + 1000 * MS
            self._measure_speed(t)
        if self._is_due("send", t, self._send_period):
            self._due["send"] = t + self._send_period
            self._canvas.send()
        self._steps += 1
        self._busy_s += perf_counter() - start
        return {}

    def flush(self) -> None:
        """Send the collected rows."""
        self._canvas.send()
        self._canvas.recording.flush()

    def finish(self) -> Mapping[str, Any]:
        """Complete the recording."""
        self.flush()
        self._canvas.recording.disconnect()
        return {
            "file": None if self._path is None else self._path.name,
            "file_bytes": 0 if self._path is None else self._path.stat().st_size,
            "steps": self._steps,
            "step_ms": 1e3 * self._busy_s / max(1, self._steps),
        }

    def _is_due(self, key: str, t: int, period: int) -> bool:
        return period == 0 or t >= self._due.get(key, 0)

    def _measure_speed(self, t: int) -> None:
        """Measure simulated over wall time since the last call; the only use of a wall clock, for display."""
        before, then = self._speed_mark
        now = perf_counter()
        self._speed_mark = (t, now)
        if t > before > 0:
            self._speed = (t - before) / 1e9 / (now - then)
            self._plots.add(t, "speed/real_time_factor", self._speed)

    def _link_poses(self, t: int, message: Message) -> None:
        self._scene.link_poses(t, message, self._in_contact, self._pressed_n)

    def _phantom(self, t: int, message: Message) -> None:
        vertices = message.surface.vertices.reshape(-1, 3)
        triangles = message.surface.triangles.reshape(-1, 3)
        raised = vertices + ABOVE_SKIN_M * vertex_normals(vertices, triangles)
        ratio = np.asarray(message.stiffness) / np.asarray(message.background)
        lesion = np.asarray(message.lesion)
        outlines = []
        for index in range(int(lesion.max(initial=-1)) + 1):
            inside = lesion == index
            if inside.any():  # half contrast, ignoring other lesions
                own = np.where(inside | (lesion < 0), ratio, 1.0)
                extreme = float(own[inside][np.abs(np.log(own[inside])).argmax()])
                outlines.append(level_lines(raised, triangles, own, (1.0 + extreme) / 2.0))
        self._map.lesions(outlines)
        self._scene.lesions(outlines)
        self._X_WA_initial = pose_matrix(message.pose)
        self._scene.body(t, self._X_WA_initial, 0.0)

    def _patient(self, t: int, message: Message) -> None:
        X_WA = pose_matrix(message.pose)
        if self._X_WA_initial is None:
            self._X_WA_initial = X_WA
        self._scene.body(t, X_WA, message.excursion)
        self._plots.add(t, "truth/breath", 1e3 * message.excursion)
        self._plots.add(t, "truth/moved", 1e3 * float(np.linalg.norm(X_WA[:3, 3] - self._X_WA_initial[:3, 3])))

    def _targets(self, t: int, message: Message) -> None:
        self._scene.targets(t, message)
        count, frames = len(message.positions), message.frames_fused
        self._plots.log(t, "log/perception", message.message or f"{count} targets from {frames} frames")

    def _wall(self, _t: int, message: Message) -> None:
        if message.state != SurfaceMotion.LOST:
            exposed = nanoseconds(message.header.stamp)
            ahead = FORECAST_INDEX * SurfaceMotion.FORECAST_STEP_MS * MS
            self._plots.add(exposed, "wall/displacement", 1e3 * message.displacement)
            self._plots.add(exposed + ahead, "wall/forecast", 1e3 * float(message.forecast[FORECAST_INDEX]))

    def _exam(self, t: int, message: Message) -> None:
        phase = plots.PHASES[message.phase][0]
        if self._plots.state(t, "state/phase", phase):
            self._scene.extend_trail(t, self._in_contact)
            if phase == "approach":
                self._scene.clear_cloud(t)
        self._in_contact = bool(message.in_contact)
        self._plots.log(t, "log/exam", message.message, "ERROR" if phase == "aborted" else "INFO")
        self._pressed_n = message.normal_force if message.depth > text.FREE_M else 0.0
        if self._in_contact:
            self._force_depth.add(t, message.depth, message.normal_force)
        for path, value in (
            ("force/measured", message.normal_force),
            ("force/limit", self._limit_n),
            ("depth/measured", depth_mm(message.depth)),
            ("depth/setpoint", depth_mm(message.depth_setpoint)),
            ("progress/targets", 100.0 * message.target_index / max(message.target_count, 1)),
        ):
            self._plots.add(t, path, value)
        if not self._is_due("text", t, PERIODS.text_ns):
            return
        self._due["text"] = t + PERIODS.text_ns
        self._plots.document(t, "text/status", text.status(self._name, phase, message, self._robot, self._speed))

    def _indentation(self, t: int, message: Message) -> None:
        self._plots.add(t, "force/true", message.normal_force)
        self._plots.add(t, "depth/true", depth_mm(message.depth))

    def _robot_status(self, t: int, message: Message) -> None:
        self._plots.add(t, "torque/joints", *(100.0 * np.asarray(message.applied_torque) / self._torque_nm))
        mode = plots.MODES[message.mode][0]
        self._robot = f"{mode}: {message.reason}" if message.reason else mode
        level = "ERROR" if message.mode == RobotStatus.MODE_SAFE_HOLD else "INFO"
        self._plots.state(t, "state/driver", mode)
        self._plots.log(t, "log/robot", self._robot, level)

    def _stiffness(self, t: int, message: Message) -> None:
        vertices = message.vertices.reshape(-1, 3)
        reached, codes = np.asarray(message.scanned, dtype=bool), np.asarray(message.unassessed)
        scanned = reached & (codes == StiffnessMap.ASSESSED)
        self._unassessed = text.unassessed(codes[reached])
        apparent = np.asarray(message.apparent, dtype=np.float64)
        if not scanned.any():
            return
        background = message.background if message.background > 0 else float(np.median(apparent[scanned]))
        ratio = apparent / background
        spread = half_width(message.lower, message.upper)
        self._map.update(t, vertices, message.triangles.reshape(-1, 3), ratio, spread, scanned)
        self._scene.stiffness(t, apply(self._X_WA, vertices.astype(np.float64)).astype(np.float32), ratio, scanned)

    def _findings(self, t: int, message: Message) -> None:
        lines = [text.finding(f) for f in message.findings]
        if lines != self._found:
            self._found = lines
            centroids = vectors(f.centroid for f in message.findings)
            labels = [f"{f.quadrant} {f.ratio:.1f} x" for f in message.findings]
            self._map.findings(t, centroids, labels)
            self._scene.findings(t, apply(self._X_WA, centroids), labels)
        if message.final:
            what = "; ".join(self._unassessed + (lines or ["no area found"]))
            self._plots.log(t, "log/findings", what, "WARN" if lines or self._unassessed else "INFO")

    def _diagnostics(self, t: int, message: Message) -> None:
        rows = [text.Health.of(status) for status in message.status]
        for row in rows:
            self._count_wait(row.values.get("waiting_for", ""))
            self._plots.health(t, row)
        self._plots.add(t, "waits/roles", *(100.0 * self._waits / max(1.0, self._waits.sum())))
        self._plots.document(t, "text/services", text.services(rows))

    def _count_wait(self, what: str) -> None:
        """Count an observed wait for a topic or for the grant; waits for observers are ignored."""
        role = self._producers.get(what, what)
        if role in plots.AWAITED:
            self._waits[plots.AWAITED.index(role)] += 1


def create(scenario: Scenario) -> DashboardService:
    """Return the dashboard of a run.

    Setting `out` is the folder of the run, `viewer` the live view (see `Live.parse`). Raises ValueError if `out` is missing or
    `viewer` is invalid.
    """
    settings = Settings.read()
    out = settings.require("out", f"the dashboard writes $PALPATE_OUT/{FILE}, so give it the run's folder")
    return DashboardService(scenario, out / FILE, Live.parse(settings.viewer or ""), full=settings.record == "full")
