"""The recording, read back from its file: what is in it, how much, and when."""

from collections import defaultdict
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rerun as rr
from dashboard_messages import OBSERVED, FakeInbox, Messages, latched, run, write_recording
from rerun.chunk import RrdReader

from palpate_bus.messages import DiagnosticArray, DiagnosticStatus, KeyValue, PhantomTruth, header
from palpate_dashboard import replay
from palpate_dashboard.layout import blueprint
from palpate_dashboard.plots import AWAITED
from palpate_dashboard.service import FILE, DashboardService, create
from palpate_dashboard.sinks import TIMELINE, Live
from palpate_models.robot.arm import link_names
from palpate_models.scenario.load import dump_scenario
from palpate_models.scenario.schema import Scenario

LINKS = link_names(Scenario().robot)
SECONDS = 6.0


@cache
def sent() -> dict[int, Messages]:
    """Return the messages of the run that most tests draw, by time [ns]."""
    return dict(run(SECONDS))


class Recording:
    """A .rrd file by entity and component."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.reader = RrdReader(path)
        self.temporal: dict[str, int] = defaultdict(int)
        self.static: set[str] = set()
        self._cells: dict[tuple[str, str], list[tuple[float, Any]]] = defaultdict(list)
        for chunk in self.reader.stream():
            if chunk.is_static:
                self.static.add(chunk.entity_path)
            else:
                self.temporal[chunk.entity_path] += chunk.num_rows
            batch = chunk.to_record_batch()
            times = [0.0] * chunk.num_rows
            if TIMELINE in batch.schema.names:
                times = [value.as_py().total_seconds() for value in batch.column(TIMELINE)]
            for name in (name for name in batch.schema.names if ":" in name):
                cells = zip(times, batch.column(name), strict=True)
                self._cells[chunk.entity_path, name] += [(time, value) for time, value in cells if value.is_valid]

    def cells(self, entity: str, component: str) -> list[tuple[float, Any]]:
        """(time [s], Arrow value) of every row, in order of time."""
        found = [rows for (path, name), rows in self._cells.items() if path == entity and name.endswith(component)]
        assert len(found) == 1, (entity, component, [key for key in self._cells if key[0] == entity])
        return sorted(found[0], key=lambda row: row[0])


WAITS = ("sim/contact_wrench", "sim/surface", "grant")
"""Two topics of the tissue's, and the conductor's grant."""


def draw(folder: Path, messages: Iterable[tuple[int, Messages]], without: tuple[str, ...] = ()) -> Recording:
    """Draw messages, without those of some topics, and return the recording."""
    rr.set_strict_mode(True)  # else the library logs its errors and continues
    service = DashboardService(Scenario(name="test"), folder / FILE, Live())
    inbox = FakeInbox()
    for t, new in messages:
        inbox.bring(t, {topic: message for topic, message in new.items() if topic not in without})
        assert service.step(t, inbox) == {}
    service.finish()
    return Recording(folder / FILE)


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    return draw(tmp_path_factory.mktemp("dashboard"), sent().items())


def test_everything_is_drawn(recording: Recording) -> None:
    expected = {
        "/world/abdomen", "/world/tool/force", "/world/tool/travelled", "/world/camera/depth", "/world/findings",
        "/world/perception/points", "/world/perception/surface", "/world/perception/targets",
        "/world/perception/normals", "/world/plan/path", "/plots/force/measured", "/plots/force/true",
        "/plots/force/limit", "/plots/depth/measured", "/plots/depth/setpoint", "/plots/depth/true",
        "/plots/truth/breath", "/plots/truth/moved", "/world/truth",
        "/plots/torque/joints", "/plots/speed/real_time_factor", "/plots/progress/targets", "/state/phase",
        "/state/driver", "/text/status", "/text/services", "/log/robot", "/log/exam", "/log/findings",
        "/log/perception", "/force_depth/past", "/force_depth/now", "/plots/waits/roles",
        "/map/mean/surface", "/map/band/surface", "/map/mean/findings",
    }  # fmt: skip
    assert expected <= recording.temporal.keys()
    for box in ("table_top", "table_column", "robot_base"):
        assert f"/world/furniture/{box}" in recording.static
    assert {"/world/truth/lesions", "/world/truth/axes", "/map/mean/truth"} <= recording.static
    assert {"/map/mean/legend", "/world/camera"} <= recording.static


def test_every_link_has_a_shape_and_moves(recording: Recording) -> None:
    for link in LINKS[1:]:
        assert f"/world/robot/{link}/shape_0" in recording.static, link
        assert recording.temporal[f"/world/robot/{link}"] > 0.9 * SECONDS * 20, link
    assert recording.temporal["/world/robot/lbr_link_0"] == 1  # the base stands still: written once


def test_a_pose_is_where_the_message_had_it(recording: Recording) -> None:
    for time, value in recording.cells("/world/robot/indenter", "Transform3D:translation")[::40]:
        links = sent()[round(time * 1e9)]["sim/link_poses"].transforms
        p = next(item for item in links if item.child_frame_id == "indenter").transform.translation
        assert value.as_py()[0] == pytest.approx((p.x, p.y, p.z), abs=1e-6)


def test_the_truth_goes_with_the_patient(recording: Recording) -> None:
    for time, value in recording.cells("/plots/truth/breath", "Scalars:scalars")[::20]:
        assert value.as_py()[0] == pytest.approx(1e3 * sent()[round(time * 1e9)]["truth/patient"].excursion)
    moved = [value.as_py()[0] for _, value in recording.cells("/plots/truth/moved", "Scalars:scalars")]
    assert (moved[0], moved[-1]) == (pytest.approx(0), pytest.approx(10))
    for time, value in recording.cells("/world/truth", "Transform3D:translation")[1::10]:
        patient = sent()[round(time * 1e9)]["truth/patient"]
        p = patient.pose.position
        assert value.as_py()[0] == pytest.approx((p.x, p.y, p.z + patient.excursion), abs=1e-6)


def test_a_soft_lump_is_outlined_where_a_stiff_one_is(recording: Recording, tmp_path: Path) -> None:
    stiff = latched()["truth/phantom"]
    share = (stiff.stiffness / stiff.background - 1) / 3
    softer = (1 - 0.8 * share) * stiff.background
    soft = PhantomTruth(stiff.surface, softer, stiff.background, stiff.lesion, stiff.pose)
    drawn = recording, draw(tmp_path, [(0, {"truth/phantom": soft})])
    outlines = (one.cells("/world/truth/lesions", "LineStrips3D:strips")[0][1].as_py() for one in drawn)
    np.testing.assert_allclose(*(np.sort(np.reshape(outline, (-1, 3)), axis=0) for outline in outlines), atol=1e-6)


def test_the_abdomen_is_written_only_while_it_changes(recording: Recording) -> None:
    rows = recording.cells("/world/abdomen", "Mesh3D:vertex_positions")
    pressed = [time for time, _ in rows if time > 0.1]
    assert min(pressed) > 0.29 * SECONDS
    assert np.diff(pressed).min() > 0.099
    still, dented = (np.array(rows[k][1].as_py()) for k in (0, -1))
    assert (still - dented)[:, 2].max() == pytest.approx(0.01, abs=1e-3)


def test_the_abdomen_is_coloured_where_it_was_scanned(recording: Recording) -> None:
    rows = [value.as_py() for _, value in recording.cells("/world/abdomen", "Mesh3D:vertex_colors")]
    (skin,) = set(rows[0])
    assert len(rows) <= SECONDS + 1
    assert 0.2 < np.mean(np.array(rows[-1]) != skin) < 0.9
    assert len(set(rows[-1])) > 5


def test_the_phases_are_written_as_they_change(recording: Recording) -> None:
    states = [(time, value.as_py()[0]) for time, value in recording.cells("/state/phase", "StateChange:state")]
    assert [name for _, name in states] == ["home", "look", "scan"]
    assert states[1][0] == pytest.approx(0.1 * SECONDS, abs=0.06)


def test_the_true_outline_is_at_half_contrast(recording: Recording) -> None:
    segments = np.array([s for _, v in recording.cells("/map/mean/truth", "LineStrips3D:strips") for s in v.as_py()])
    radius = np.hypot(segments[..., 0] + 0.05, segments[..., 1] + 0.05)
    assert radius == pytest.approx(0.03, abs=2e-3)  # the edge is 3 mm wide, the mesh 6 mm
    length = np.linalg.norm(np.diff(segments[..., :2], axis=1)[:, 0], axis=1).sum()
    assert length == pytest.approx(2 * np.pi * 0.03, rel=0.05)


def test_it_stays_small(recording: Recording, tmp_path: Path) -> None:
    """At most 60 MB for an examination of 150 s, extrapolated from runs that are in contact most of their time."""
    half, whole = (drawn.path.stat().st_size for drawn in (draw(tmp_path, run(SECONDS / 2)), recording))
    assert 0 < half + (whole - half) * (150 / SECONDS * 2 - 1) < 60e6


def test_the_file_has_the_layout(recording: Recording) -> None:
    (layout,) = recording.reader.blueprints()
    batches = [chunk.to_record_batch() for chunk in recording.reader.stream(store=layout)]

    def values(field: str) -> set[str]:
        columns = [batch.column(name) for batch in batches for name in batch.schema.names if name.endswith(field)]
        return {value[0] for column in columns for value in column.to_pylist() if value}

    origins, kinds = values("ViewBlueprint:space_origin"), values("ViewBlueprint:class_identifier")
    assert {"/world", "/map/mean", "/map/band", "/world/camera", "/plots/force", "/plots/depth", "/state"} <= origins
    assert {"3D", "2D", "TimeSeries", "TextDocument", "TextLog", "StateTimeline"} <= kinds
    logged = recording.temporal.keys() | recording.static
    for origin in origins:
        assert any(path == origin or path.startswith(origin + "/") for path in logged), origin


def _parts(part: Any) -> list[Any]:
    """Return a part of the layout and all within it, outermost first."""
    inner = [item for item in getattr(part, "contents", ()) if not isinstance(item, str)]
    return [part, *(found for item in inner for found in _parts(item))]


def test_the_truth_about_the_patient_is_not_shown_at_first() -> None:
    parts = _parts(blueprint((0.2, 0.2), (0.0, 0.0), 0.01, ((0.0, 1.0), (0.0, 1.0))).root_container)
    views = {part.origin: part for part in parts if hasattr(part, "origin")}
    secret = views["/plots/truth"]
    (holder,) = [part for part in parts if type(part).__name__ == "Tabs" and secret in part.contents]
    assert holder.contents[0] is not secret  # the first tab is in front
    drawn = ("/world truth/lesions", "/world truth/axes", "/map/mean truth", "/plots/force true", "/plots/depth true")
    for origin, name in map(str.split, drawn):
        override = views[origin].visualizer_overrides[f"{origin}/{name}"]
        assert override.visible.as_arrow_array().to_pylist() == [False]


@pytest.mark.parametrize("topic", sorted(OBSERVED))
def test_any_topic_may_be_missing(tmp_path: Path, topic: str) -> None:
    assert draw(tmp_path, run(0.5), without=(topic,)).temporal


def test_starting_late_shows_what_is_latched(tmp_path: Path) -> None:
    late = [(t, new) for t, new in run(4.0) if t > 2_500_000_000]
    late[0] = (late[0][0], late[0][1] | latched())
    recording = draw(tmp_path, late)
    assert "/world/truth/lesions" in recording.static
    assert "/world/robot/lbr_link_3/shape_0" in recording.static
    assert min(time for time, _ in recording.cells("/world/abdomen", "Mesh3D:vertex_positions")) > 2.5


def test_steps_that_are_missed_or_come_twice(tmp_path: Path) -> None:
    twice = [pair for i, pair in enumerate(run(4.0)) if i % 7 for _ in range(2)]
    times = [time for time, _ in draw(tmp_path, twice).cells("/plots/force/measured", "Scalars:scalars")]
    assert len(times) == len(set(times))


def test_the_last_messages_are_drawn_even_at_the_same_time(tmp_path: Path) -> None:
    """A distributed observer may step again at a time at which it has stepped: what came in between must not be lost."""
    steps = list(run(2.0))
    last, new = steps[-1]
    findings = {"assessment/findings": new["assessment/findings"]}
    steps = [(t, {k: v for k, v in m.items() if k != "assessment/findings"}) for t, m in steps]
    assert draw(tmp_path, [*steps, (last, findings)]).temporal["/world/findings"] == 1


def test_create_wants_the_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PALPATE_OUT", str(tmp_path / "new"))
    create(Scenario()).finish()
    assert (tmp_path / "new" / FILE).stat().st_size > 0
    monkeypatch.setenv("PALPATE_VIEWER", "hologram")
    with pytest.raises(ValueError, match="PALPATE_VIEWER=hologram"):
        create(Scenario())
    monkeypatch.delenv("PALPATE_OUT")
    with pytest.raises(ValueError, match="PALPATE_OUT"):
        create(Scenario())


def test_a_replay_draws_what_the_run_drew(tmp_path: Path) -> None:
    steps = [(t, {k: v for k, v in new.items() if k in OBSERVED}) for t, new in run(3.0)]
    live = draw(tmp_path, steps)
    write_recording(tmp_path, steps)
    file = tmp_path / "scenario.yaml"
    file.write_text(dump_scenario(Scenario(name="replayed")), encoding="utf-8")
    again = Recording(replay.replay(replay.recording_of(tmp_path), file, tmp_path / "again.rrd"))
    assert live.temporal.pop("/plots/speed/real_time_factor")  # of wall time, which a replay does not have
    live.temporal.pop("/text/status")
    again.temporal.pop("/text/status")
    assert again.temporal == live.temporal
    assert again.static == live.static


def test_force_over_depth_holds_every_reading_in_contact_once(recording: Recording) -> None:
    pieces = recording.cells("/force_depth/past", "Points2D:positions")
    points = np.concatenate([np.array(value.as_py()) for _, value in pieces])
    force = dict(recording.cells("/plots/force/measured", "Scalars:scalars"))
    depth = dict(recording.cells("/plots/depth/measured", "Scalars:scalars"))
    pressed = [t for t, value in force.items() if value.as_py()[0] > 0.1]
    assert len(pressed) - 20 <= len(points) <= len(pressed)
    assert points[:, 0] == pytest.approx([10 * depth[t].as_py()[0] for t in pressed[: len(points)]], rel=1e-5)
    assert points[:, 1] == pytest.approx([-10 * force[t].as_py()[0] for t in pressed[: len(points)]], rel=1e-5)


def test_blame_is_of_those_who_were_waited_for(tmp_path: Path) -> None:
    messages = list(run(3.0))
    for _, new in messages:
        for status, what in zip(new["diagnostics"].status if "diagnostics" in new else (), WAITS, strict=False):
            status.values = [KeyValue("waiting_for", what)]
    drawn = draw(tmp_path, messages, without=("sim/surface", "camera/depth/image_raw", "perception/points"))
    share = dict(zip(AWAITED, drawn.cells("/plots/waits/roles", "Scalars:scalars")[-1][1].as_py(), strict=True))
    assert {role: part for role, part in share.items() if part} == pytest.approx({"tissue": 200 / 3, "grant": 100 / 3})


def test_a_topic_and_its_sender_in_trouble_are_shown_with_the_reason(tmp_path: Path) -> None:
    what = [("palpate/topic/truth/patient", "from tissue: norm of a quaternion"), ("palpate/tissue", "truth/patient")]
    rows = [DiagnosticStatus(DiagnosticStatus.ERROR, name, text, "tissue", []) for name, text in what]
    drawn = draw(tmp_path, [(10**9, {"diagnostics": DiagnosticArray(header(10**9), rows)}), (2 * 10**9, {})])
    for entity in ("/health/topics/truth/patient", "/health/services/tissue"):
        assert drawn.cells(entity, "StateChange:state")[-1][1].as_py() == ["ERROR"]
    assert any("norm of a quaternion" in str(text) for _, text in drawn.cells("/log/health/topics/truth/patient", "text"))
    assert "| truth/patient | ERROR |" in str(drawn.cells("/text/services", "text")[-1])
