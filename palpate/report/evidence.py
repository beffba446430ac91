"""A run's messages: written to and read from its results folder, and as arrays, for scores, report and figures.

evidence.mcap has the messages that the conductor collected and, as an attachment, the truth of a simulated run. The report is
built from it, with or without a recording of the whole run. A run that was killed has no evidence.mcap; then the same messages
are read from its recording.
"""

import io
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from itertools import groupby, pairwise
from math import hypot
from operator import attrgetter
from pathlib import Path
from time import sleep, time
from typing import Any, Final, NamedTuple

import numpy as np
from mcap.reader import make_reader
from numpy.typing import NDArray

from palpate.replay.golden import rerun, write_recording
from palpate.report.scoring import Map, Truth
from palpate.truth.pressed import Felt, Pressed, Touched, TrueBody, TrueSurface
from palpate_assessment.sampling import TRAVEL
from palpate_bus.contract import CONDUCTOR, contract
from palpate_bus.mcap_records import BROKEN, RecordingError
from palpate_bus.messages import NS, StiffnessMap, codec, nanoseconds
from palpate_bus.messages.geometry import pose_matrix
from palpate_bus.recordings import RecordedMessage, Recording, open_recording
from palpate_bus.runs.announcement import live_runs
from palpate_bus.runs.run_folder import in_use
from palpate_bus.settings import RECORDING
from palpate_conductor.collector import Collected, Collector
from palpate_errors import UserError, restate
from palpate_inputs import InputFile, read_arrays, read_json
from palpate_models.numerics.frames import Array, apply, inverse
from palpate_models.patient.motion import BodyMotion
from palpate_models.scenario.load import ScenarioError, exam_input, load_scenario
from palpate_models.scenario.schema import Scenario
from palpate_recorder.recover import salvage

xyz: Final = attrgetter("x", "y", "z")
"""Coordinates of a point or vector of a message."""


def columns_of(rows: Iterable[tuple[Any, ...]], kinds: np.dtype[Any]) -> dict[str, NDArray[Any]]:
    """Return an array for each field of `kinds`, without holding all rows in memory."""
    table = np.fromiter(rows, kinds)
    return {name: np.ascontiguousarray(table[name]) for name in kinds.names or ()}


def points(message: Any, field: str = "vertices") -> Array:
    """Return a flat array of a message as points, shape (n, 3)."""
    return np.asarray(getattr(message, field), dtype=np.float64).reshape(-1, 3)


def unsampled_targets(scenario: Scenario, targets: Any, sampled: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Return the targets of `perception/targets` in A [m], shape (n, 2), and a mask of those without a sample near.

    `sampled`: positions of the samples in A [m], shape (m, 3). Near is half a spacing, or the travel that a sample averages.
    """
    p_W = np.array([xyz(p) for p in targets.positions]).reshape(-1, 3)
    p_A: Array = apply(inverse(np.array(exam_input(scenario).X_WA)), p_W)[:, :2]
    away = np.linalg.norm(p_A[:, None] - sampled.reshape(-1, 3)[:, :2], axis=-1)
    return p_A, away.min(axis=1, initial=np.inf) > max(scenario.exam.spacing_m / 2, TRAVEL)


def body_of(message: Any) -> TrueBody:
    """Return the body of a `palpation_msgs/PhantomTruth`."""
    triangles = np.asarray(message.surface.triangles, dtype=np.int32).reshape(-1, 3)
    return TrueBody(points(message.surface), triangles, pose_matrix(message.pose))


def felt_truth(scenario: Scenario, body: TrueBody, pressed: Pressed, touched: Touched) -> Truth:
    """Return the truth of a run whose patient was pressed."""
    felt = Felt(pressed, TrueSurface(body), scenario.exam)
    return Truth(body, felt, touched, np.array(exam_input(scenario).X_WA))


def map_of(message: Any) -> Map:
    """Return the map of a `palpation_msgs/StiffnessMap`; unassessed places do not count as scanned."""
    return Map(
        vertices=points(message),
        apparent=np.asarray(message.apparent, dtype=np.float64),
        lower=np.asarray(message.lower, dtype=np.float64),
        upper=np.asarray(message.upper, dtype=np.float64),
        scanned=np.asarray(message.scanned, dtype=bool) & (np.asarray(message.unassessed) == StiffnessMap.ASSESSED),
        finding=np.asarray(message.finding, dtype=np.int32),
    )


def unassessed_of(message: Any) -> dict[str, float]:
    """Return the scanned but unassessed area of the map by reason [m^2], without reasons that do not occur."""
    p, triangles = points(message), np.asarray(message.triangles, dtype=np.int64).reshape(-1, 3)
    a, b, c = (p[triangles[:, k]] for k in range(3))
    third = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 6
    area = np.bincount(triangles.ravel(), np.repeat(third, 3), minlength=len(p))
    codes = np.asarray(message.unassessed)
    reasons = {"contradicted": StiffnessMap.CONTRADICTED, "yielded": StiffnessMap.YIELDED}
    return {reason: float(area[codes == code].sum()) for reason, code in reasons.items() if (codes == code).any()}


def sample_columns(messages: Iterable[Any]) -> dict[str, NDArray[Any]]:
    """Return the columns of samples.csv, each of shape (m,), of m `palpation_msgs/PalpationSample`, in the abdomen frame."""
    return columns_of(
        (
            (nanoseconds(m.header.stamp) / NS, *xyz(m.position), *xyz(m.normal), m.depth, m.normal_force, m.tangential_speed,
             m.time_in_contact, m.depth_uncertainty, m.stroke, m.force_limited)
            for m in messages
        ),
        _SAMPLE,
    )  # fmt: skip


_SAMPLE: Final = np.dtype([
    *((name, "f8") for name in ("time_s", "x_m", "y_m", "z_m", "nx", "ny", "nz", "depth_m", "normal_force_N", "speed_mps",
                                "time_in_contact_s", "depth_uncertainty_m", "stroke")),
    ("force_limited", "?"),
])  # fmt: skip


def peak_force(message: Any) -> float:
    """Return the maximum contact force [N] since the previous `palpation_msgs/IndentationTruth`, including its current one."""
    return max(float(message.peak_force), hypot(message.normal_force, message.tangential_force))


def steady_contact(
    exam_states: Iterable[Any], indentation: Iterable[Any], X_WA: Array, motion: BodyMotion, registered_X_WA: Array
) -> Any:
    """Return measured and true contact at equal stamps while the contact is reported steady: `_CONTACT` records by time.

    Args:
        exam_states: `exam/state`; of several with one stamp the first counts.
        indentation: `truth/indentation`.
        X_WA: true pose of A in world at the start.
        motion: motion of the body from there.
        registered_X_WA: registered pose of A in world.
    """

    def shared(m: Any) -> tuple[Any, ...]:
        return nanoseconds(m.header.stamp), m.depth, xyz(m.surface_point)

    reported = columns_of(((*shared(s), s.depth_setpoint, s.force_limited) for s in exam_states if s.steady), _STEADY)
    true = columns_of(map(shared, indentation), _SHARED)
    stamps, at, truly = np.intersect1d(reported["stamp"], true["stamp"], return_indices=True)
    contact = np.zeros(len(stamps), _CONTACT).view(np.recarray)
    contact["measured"], contact["true"] = reported["depth"][at], true["depth"][truly]
    contact["wanted"], contact["limited"] = reported["wanted"][at], reported["limited"][at]
    contact["believed"] = apply(inverse(registered_X_WA), reported["place"][at])
    contact["touched"] = motion.on_body(stamps / NS, apply(inverse(X_WA), true["place"][truly]))
    return contact


_SHARED: Final = np.dtype([("stamp", "i8"), ("depth", "f8"), ("place", "f8", 3)])
_STEADY: Final = np.dtype([*_SHARED.descr, ("wanted", "f8"), ("limited", "?")])
_CONTACT: Final = np.dtype([
    *((name, "f8") for name in ("measured", "true", "wanted")), ("limited", "?"), ("believed", "f8", 3), ("touched", "f8", 3)
])  # fmt: skip
"""Measured, true and wanted depth [m]; whether depth yields to the force limit; estimated and true place on the rest surface
under the indenter [m], in the registered and in the true A."""


FILE: Final = "evidence.mcap"
_TRUTH: Final = "truth.npz"
"""Attachment: name of the run, touched places, forces of the pressed copy of the patient."""
_TOPICS: Final = {
    "exam_states": "exam/state",
    "indentation": "truth/indentation",
    "motions": "perception/motion",
    "samples": "assessment/samples",
    "status_changes": "robot/status",
    "supervisor": "supervisor/state",
    "phantom": "truth/phantom",
    "surface": "perception/surface",
    "correction": "exam/correction",
    "targets": "perception/targets",
    "stiffness_map": "assessment/map",
    "findings": "assessment/findings",
}
"""Topic of each field of `Collected`."""
_MAGIC: Final = b"\x89MCAP0\r\n"
"""First and last bytes of a complete file."""
_STILL_S: Final = 3.0
"""A recording that has not grown for this long is complete: its recorder writes every simulated second."""


class EvidenceError(UserError):
    """A folder without a readable run. Names the file and what to do."""


class NothingRecordedError(EvidenceError):
    """An interrupted run of which nothing was recorded."""


class Event(NamedTuple):
    """A message of the examination or a change of the driver, for the reader of a report."""

    time_s: float
    """Simulated."""
    source: str
    """exam or driver."""
    text: str


@dataclass(frozen=True)
class Evidence:
    """The collected messages of a run and its truth, for its report; n exam states and m true contacts, in order of time."""

    collected: Collected
    touched: Touched
    """Estimated and true places on the skin under the indenter."""
    pressed: Pressed | None
    """Forces of a pressed copy of the patient; None if none can be made."""
    run: str = ""
    """Name of the run."""

    @cached_property
    def states(self) -> Any:
        """The exam states as a record array, shape (n,): time [s], phase (ExamState.PHASE_*), depth and setpoint [m], tared
        normal force [N], flags, targets skipped and in all.
        """
        rows = ((nanoseconds(s.header.stamp) / NS, *_values(s)) for s in self.collected.exam_states)
        return np.fromiter(rows, [("time", "f8"), *((name, kind) for name, _, kind in _STATE)]).view(np.recarray)

    @cached_property
    def contacts(self) -> Any:
        """The true contact as a record array, shape (m,): time [s], depth [m], normal force [N]."""
        rows = ((nanoseconds(m.header.stamp) / NS, m.depth, m.normal_force) for m in self.collected.indentation)
        return np.fromiter(rows, [("time", "f8"), ("depth", "f8"), ("force", "f8")]).view(np.recarray)

    @property
    def target_count(self) -> int:
        """Number of targets."""
        return int(self.states.target_count.max(initial=0))

    @cached_property
    def events(self) -> list[Event]:
        """Every new message of the examination and every change of the driver, in order of time."""
        events = []
        for text, states in groupby(self.collected.exam_states, key=attrgetter("message")):
            if text:
                events.append(Event(nanoseconds(next(states).header.stamp) / NS, "exam", text))
        for status in self.collected.status_changes:
            text = status.reason or ("idle", "follows commands", "safe hold")[status.mode]
            events.append(Event(nanoseconds(status.header.stamp) / NS, "driver", text))
        return sorted(events, key=attrgetter("time_s"))

    def phases(self) -> list[tuple[int, float, float]]:
        """Return phase, begin and end [s] of each phase, in order."""
        time, phase = self.states.time, self.states.phase
        starts = [0, *(np.flatnonzero(np.diff(phase.astype(int))) + 1), len(phase)]
        return [(int(phase[a]), float(time[a]), float(time[b - 1])) for a, b in pairwise(starts) if b > a]


_STATE: Final = (
    ("phase", "phase", "u1"),
    ("depth", "depth", "f8"),
    ("setpoint", "depth_setpoint", "f8"),
    ("force", "normal_force", "f8"),
    *((flag, flag, "?") for flag in ("in_contact", "steady", "force_limited")),
    ("skipped", "targets_skipped", "u4"),
    ("target_count", "target_count", "u4"),
)
"""Columns of the exam states: name, field and type."""
_values: Final = attrgetter(*(field for _, field, _ in _STATE))


def write_evidence(
    path: Path, c: Collected, touched: Touched | None = None, pressed: Pressed | None = None, run: str = ""
) -> None:
    """Write the collected messages of the run named `run`, complete or not, and its truth if known."""
    known: dict[str, Any] = {"run": np.array(run)}
    if touched is not None:
        known |= {"touched_believed": touched.believed, "touched_true": touched.true}
    if pressed is not None:
        known |= {f"pressed_{name}": values for name, values in pressed._asdict().items()}
    truth = io.BytesIO()
    np.savez_compressed(truth, **known)
    messages = sorted(_messages(c), key=attrgetter("stamp"))
    write_recording(path, contract(), messages, {_TRUTH: ("application/octet-stream", truth.getvalue())})


def _messages(c: Collected) -> Iterator[RecordedMessage]:
    """Yield all collected messages, topic by topic."""
    for field, topic in _TOPICS.items():
        encode = codec.encoder(contract().topics[topic].type)
        kept = getattr(c, field)
        messages = () if kept is None else kept if field in _SEQUENCES else (kept,)
        for number, message in enumerate(messages, start=1):
            # the phantom is sent once, at the start; samples of a resumed run are stamped before it
            stamp = max(nanoseconds(message.header.stamp), 0) if hasattr(message, "header") else 0
            yield RecordedMessage(stamp, topic, encode(message), number)


_SEQUENCES: Final = ("exam_states", "indentation", "motions", "samples", "status_changes")


def _read_collected(evidence: Recording) -> Collected:
    """Return the messages that `_messages` wrote."""
    evidence.check(contract(), list(evidence.types))
    fields = {topic: field for field, topic in _TOPICS.items()}
    kept: dict[str, Any] = {field: [] for field in _SEQUENCES}
    for message in evidence.messages(list(evidence.types)):
        field = fields[message.topic]
        decoded = codec.decode(message.payload, contract().topics[message.topic].type)
        if field in _SEQUENCES:
            kept[field].append(decoded)
        else:
            kept[field] = decoded
    return Collected(**kept)


def collect(recording: Recording) -> Collected:
    """Return the messages of a recording that a conductor collects. Raises RecordingError."""
    collector = Collector()
    end = tick_after(recording.last, collector.role)
    for _ in rerun(collector, contract(), inputs(recording, collector.role), end):
        pass
    return collector.collected


def tick_after(t: int, role: str) -> int:
    """Return the first tick [ns] of a role after `t` [ns]."""
    period = contract().roles[role].period
    return t - t % period + period


def inputs(recording: Recording, role: str) -> Iterator[RecordedMessage]:
    """Return the recorded inputs of a role, in order. Raises RecordingError."""
    topics = [topic.name for topic, _ in contract().inputs(role) if topic.name in recording.types]
    recording.check(contract(), topics)
    return recording.messages(topics)


def read_evidence(folder: Path) -> Evidence:
    """Return the evidence of the run in `folder`. Raises EvidenceError."""
    path = folder / FILE
    if not path.is_file():
        raise EvidenceError(f"{path} is not there: give the results folder; after a loss of the conductor with --recover")
    try:
        with InputFile(path, EvidenceError) as stream:
            reader = make_reader(stream)
            attached = {a.name: a.data for a in reader.iter_attachments()}
            summary = reader.get_summary()
        known = read_arrays(attached[_TRUTH], path, EvidenceError)
        collected = _read_collected(open_recording(path)) if summary is not None and summary.channels else Collected()
        nowhere = np.empty((0, 3))
        touched = Touched(known.get("touched_believed", nowhere), known.get("touched_true", nowhere))
        named = {name: known[f"pressed_{name}"] for name in Pressed._fields if f"pressed_{name}" in known}
        return Evidence(collected, touched, Pressed(**named) if named else None, str(known["run"]))
    except (KeyError, TypeError) as error:
        raise EvidenceError(f"{path} is of another version of Palpate ({error}): run the examination again") from error
    except (OSError, *BROKEN) as error:
        raise EvidenceError(f"{path} cannot be read ({error}): run the examination again") from error


def read_completed(folder: Path) -> dict[str, Any] | None:
    """Return report.json of a completed run with its evidence; None if there is none."""
    with suppress(OSError, ValueError, KeyError, TypeError):
        report: dict[str, Any] = read_json(folder / "report.json")
        with (folder / FILE).open("rb") as file:
            file.seek(-len(_MAGIC), io.SEEK_END)
            return report if report["failure"] is None and file.read() == _MAGIC else None
    return None


class InterruptedRun(NamedTuple):
    """A run without results or with those of a failure."""

    folder: Path
    scenario: Scenario
    recording: Recording
    collected: Collected


def read_interrupted(folder: Path) -> InterruptedRun:
    """Read the folder of a run.

    Raises EvidenceError if the run is still active or its files cannot be read, NothingRecordedError if it has no recording.
    """
    with restate(OSError, EvidenceError, f"{folder}: cannot be read"):
        if in_use(folder) or any(Path(run.out).resolve() == folder.resolve() for run in live_runs()):
            raise EvidenceError(f"{folder}: its run is still active; stop it first")
    with restate((RecordingError, ScenarioError), EvidenceError, f"{folder}: nothing can be recovered"):
        scenario = load_scenario(str(folder / "scenario.yaml"))
        recording = _recording(folder)
        collected = _read_collected(recording) if recording.path.name == FILE else collect(recording)
        return InterruptedRun(folder, scenario, recording, collected)


def _recording(run: Path) -> Recording:
    """Return the recording of a run, which may be incomplete or damaged, or else its evidence."""
    folder = run / RECORDING
    parts = sorted(folder.glob("*.mcap"))
    if not parts:
        if (run / FILE).is_file():
            return open_recording(run / FILE)
        raise NothingRecordedError(f"{run}: nothing can be recovered: it has no recording and no {FILE}")
    while not (folder / "metadata.yaml").is_file() and time() - parts[-1].stat().st_mtime < _STILL_S:
        sleep(0.1)  # the recorder outlives the conductor by some seconds
    with restate((OSError, ValueError), NothingRecordedError, f"{folder}: nothing can be recovered"):
        return salvage(folder, [topic.name for role in (CONDUCTOR, "assessment") for topic, _ in contract().inputs(role)])
