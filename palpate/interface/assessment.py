"""The assessment of touches of a patient: the assessment service, without a bus."""

import base64
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from io import BytesIO
from itertools import chain
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.tri import Triangulation
from threadpoolctl import threadpool_limits

from palpate.apart import run_guarded
from palpate.exam_state import exam_state
from palpate.quick.case import assess as have_assessed
from palpate.quick.patient import PERIOD_S, Seen, Touch
from palpate.recording.assessed import collect_assessed
from palpate.recording.recording import PalpationRecording
from palpate.report.evidence import map_of, sample_columns
from palpate.report.rows import FindingRow, finding_rows
from palpate.report.scoring import Map
from palpate.run.composed import load_services
from palpate.run.roles import foreign_roles
from palpate_bus.messages import NS, ExamState, header
from palpate_bus.messages.geometry import mesh_message
from palpate_conductor.collector import Collected
from palpate_models.numerics.frames import Array, Ints, apply
from palpate_models.numerics.maps import half_width
from palpate_models.scenario.load import exam_input
from palpate_planning.contact import THRESHOLDS

DEPTH_SD_M = 0.0003
"""Published SD of depth [m]: indenter and skin are known exactly except between the points of the mesh (assumed)."""


@dataclass(frozen=True, eq=False)
class StiffnessMap(Map):
    """Apparent stiffness over the skin with its 90 % band; n nodes, in the abdomen frame as registered."""

    triangles: Ints
    """Nodes of each triangle, shape (m, 3), counter-clockwise seen from outside."""
    background: float
    """Level of the unremarkable tissue's apparent stiffness [N]."""

    @classmethod
    def of(cls, message: Any) -> "StiffnessMap":
        """Return the map of a `palpation_msgs/StiffnessMap`."""
        triangles = np.asarray(message.triangles, dtype=np.int64).reshape(-1, 3)
        return cls(**vars(map_of(message)), triangles=triangles, background=float(message.background))

    @property
    def uncertainty(self) -> Array:
        """Half width of the 90 % band [1], shape (n,): the factor from the middle to either end, minus one."""
        return half_width(self.lower, self.upper)

    @property
    def frame(self) -> pd.DataFrame:
        """One row per node."""
        x, y, z = self.vertices.T
        columns = {"x_m": x, "y_m": y, "z_m": z, "apparent_N": self.apparent, "lower_N": self.lower, "upper_N": self.upper}
        return pd.DataFrame({**columns, "scanned": self.scanned, "finding": self.finding})

    def plot(self, axes: Axes | None = None, values: Array | None = None, label: str = "", cmap: str = "inferno") -> Axes:
        """Draw the map seen from the front, in millimetres.

        Parameters
        ----------
        axes
            Axes to draw on; new axes by default.
        values
            Values of the nodes, shape (n,); by default the apparent stiffness [N].
        label, cmap
            Label and colours of the colour bar.

        Returns
        -------
        Axes
            The axes drawn on.
        """
        if axes is None:
            from matplotlib import pyplot  # noqa: PLC0415 - given axes need no windows

            axes = pyplot.subplots()[1]
        shown, default = (self.apparent, "apparent stiffness [N]") if values is None else (values, "")
        mesh = Triangulation(1e3 * self.vertices[:, 0], 1e3 * self.vertices[:, 1], self.triangles)
        image = axes.tripcolor(mesh, shown, cmap=cmap, shading="gouraud")
        figure = axes.get_figure()
        assert figure is not None
        figure.colorbar(image, ax=axes, label=label or default)
        axes.set(aspect="equal", xlabel="x, to the patient's left [mm]", ylabel="y, to the head [mm]")
        return axes


@dataclass(frozen=True, eq=False)
class Assessment:
    """Result of an assessment of touches."""

    samples: pd.DataFrame
    """Samples that the assessment used, with the columns of samples.csv."""
    map: StiffnessMap | None
    """None if there are too few samples, or if the assessment publishes no map."""
    findings: pd.DataFrame
    """One row per stiff area."""
    facts: dict[str, Any] = field(default_factory=dict)
    """Facts that the assessment service reported at its end."""

    def __repr__(self) -> str:
        return f"Assessment({len(self.samples)} samples, {len(self.findings)} findings{'' if self.map else ', no map yet'})"

    def _repr_html_(self) -> str:
        picture = "" if self.map is None else html_of(draw_png(self.map, self.samples))
        return f"<p>{len(self.samples)} samples</p>{findings_html(self.findings)}{picture}"


def assess(touches: Touch | Iterable[Touch] | PalpationRecording) -> Assessment:
    """Return map and findings of touches, computed by the assessment service of the scenario as in an examination.

    The service receives the same inputs as in an examination: the perceived surface, and force and depth over time.

    Parameters
    ----------
    touches
        Results of `Patient.press` and `Patient.slide`, all of one patient, in any order. Only forces at depth count: a press
        without a hold adds no sample. Or a recording, see `read_recording`.

    Returns
    -------
    Assessment
        Samples, map and findings. Map and findings are empty if there are too few samples.

    Raises
    ------
    ValueError
        There are no touches, or they are of several patients.
    PluginError
        The scenario's assessment cannot be created.

    Examples
    --------
    >>> import palpate
    >>> patient = palpate.Patient(palpate.scenario("clean", exam={"region_m": [0.1, 0.1], "centre_m": [-0.05, -0.05]}))
    >>> lines = [[(-0.10, y), (0.0, y)] for y in (-0.10, -0.0875, -0.075, -0.0625, -0.05, -0.0375, -0.025, -0.0125, 0.0)]
    >>> found = palpate.assess(patient.slide(line, depth=0.010, speed=0.03) for line in lines)
    >>> found.findings.quadrant.tolist()
    ['RLQ']
    >>> bool(found.findings.ratio[0] > 1.8)
    True
    """
    if isinstance(touches, PalpationRecording):
        return _assessment(collect_assessed(touches), {})
    felt = sorted([touches] if isinstance(touches, Touch) else touches, key=lambda touch: float(touch.time[0]))
    if not felt:
        raise ValueError("touches: there are none; expected the results of Patient.press and Patient.slide")
    seen = felt[0].seen
    if any(touch.seen is not seen for touch in felt):
        raise ValueError("touches: they are of several patients; expected touches of one patient")
    gathered = _gather(seen, felt)

    def work() -> tuple[Collected, dict[str, Any]]:
        (service,) = load_services(seen.scenario, ("assessment",))
        with threadpool_limits(1):  # the result must not depend on the number of threads
            return gathered, have_assessed(service, gathered)

    foreign = "assessment" in foreign_roles(seen.scenario)
    return _assessment(*(run_guarded("services.assessment", work, math.inf) if foreign else work()))


def _assessment(gathered: Collected, facts: dict[str, Any]) -> Assessment:
    found = findings_frame([] if gathered.findings is None else finding_rows(gathered.findings.findings))
    stiffness = None if gathered.stiffness_map is None else StiffnessMap.of(gathered.stiffness_map)
    return Assessment(pd.DataFrame(sample_columns(gathered.samples)), stiffness, found, facts)


def _gather(seen: Seen, touches: Sequence[Touch]) -> Collected:
    """Return the touches as messages of an examination, in the world frame, with the patient as registered."""
    X_WA = np.array(exam_input(seen.scenario).X_WA)
    R_WA = X_WA[:3, :3]
    states = list(chain.from_iterable(_states(touch, X_WA, stroke) for stroke, touch in enumerate(touches, start=1)))
    over = round((float(touches[-1].time[-1]) + 2 * PERIOD_S) * NS)
    states.append(_state(over, ExamState.PHASE_ASSESS, X_WA[:3, 3], R_WA[:, 2], len(touches)))
    surface = mesh_message(header(0, "world"), apply(X_WA, seen.places), seen.normals @ R_WA.T)
    return Collected(exam_states=states, surface=surface)


def _states(touch: Touch, X_WA: Array, stroke: int) -> list[Any]:
    """Return `exam/state` at each time of a touch, with its stroke number, and one state after it, out of contact."""
    places, normals = apply(X_WA, touch.position), touch.normal @ X_WA[:3, :3].T
    felt = zip(touch.depth.tolist(), touch.force.tolist(), strict=True)
    rows, scan = zip(touch.time, places, normals, felt, touch.steady.tolist(), strict=True), ExamState.PHASE_SCAN
    states = [_state(round(t * NS), scan, p, n, stroke, pair, steady) for t, p, n, pair, steady in rows]
    return [*states, _state(round((touch.time[-1] + PERIOD_S) * NS), ExamState.PHASE_RETRACT, places[-1], normals[-1], stroke)]


def _state(
    t: int, phase: int, p_W: Array, n_W: Array, stroke: int, felt: tuple[float, float] = (0.0, 0.0), steady: bool = False
) -> Any:
    """Return `exam/state` at time `t` [ns]; `felt` is the measured depth [m] and force [N]."""
    depth, force = felt
    touching = force > THRESHOLDS.on_n
    measured = {"depth_setpoint": depth, "depth": depth, "normal_force": force, "depth_uncertainty": DEPTH_SD_M}
    return exam_state(t, phase, p_W, n_W, in_contact=touching, steady=steady and touching, stroke=stroke, **measured)


def findings_frame(rows: Iterable[FindingRow]) -> pd.DataFrame:
    """Return a row per finding: position [m], area [m^2], ratio of apparent stiffness to the surroundings with its 90 % band,
    and the probabilities of a lump, a tensed muscle, a ridge, bone and a soft defect.
    """
    columns = ("quadrant", "x_m", "y_m", "z_m", "area_m2", "ratio", "ratio_lower", "ratio_upper")
    kinds = ("confidence", "guarding", "ridge", "bone", "soft", "kind")
    values = [(f.quadrant, *f.centroid_m, f.area_m2, f.ratio, *f.ratio_90, *(getattr(f, kind) for kind in kinds)) for f in rows]
    return pd.DataFrame(values, columns=[*columns, *kinds])


def findings_html(findings: pd.DataFrame) -> str:
    """Return the findings as an HTML table, or a sentence if there are none."""
    return str(findings.to_html(index=False, float_format="{:.3g}".format)) if len(findings) else "<p>no finding</p>"


def draw_png(found: StiffnessMap, samples: pd.DataFrame) -> bytes:
    """Return a PNG of the map with the positions of the samples."""
    figure = Figure(figsize=(5.2, 4.2), dpi=110, layout="constrained")
    axes = found.plot(figure.add_subplot())
    axes.plot(1e3 * samples.x_m, 1e3 * samples.y_m, ".", ms=2, color="white", alpha=0.6)
    file = BytesIO()
    figure.savefig(file, format="png")
    return file.getvalue()


def html_of(png: bytes, width: str = "auto") -> str:
    """Return an HTML image with embedded data."""
    return f'<img style="width: {width}" src="data:image/png;base64,{base64.b64encode(png).decode()}">'
