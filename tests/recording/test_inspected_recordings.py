"""Proposed mappings of tables of many writers, and recordings of real robots, which are not part of the project."""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner

from palpate.commands import app_for
from palpate.interface.assessment import assess
from palpate.recording import readings
from palpate.recording.command import scenario_of
from palpate.recording.inspect import propose
from palpate.recording.mapping import read_mapping
from palpate.recording.read import read_recording
from palpate.recording.readings import read_table
from palpate_errors import ExitStatus, UserError
from palpate_inputs import Bounds

HEADERS = {
    "plain": ("probe", "x", "y", "z", "fx", "fy", "fz"),
    "german": ("Messpunkt", "Position X (mm)", "Position Y (mm)", "Position Z (mm)", "Kraft X [N]", "Kraft Y [N]", "Kraft Z [N]"),
    "joined": ("Punkt Nr.", "posx", "posy", "posz", "FxN", "FyN", "FzN"),
    "messages": ("id", *(f"pose.position.{axis}" for axis in "xyz"), *(f"wrench.force.{axis}" for axis in "xyz")),
    "one force": ("point_id", "tip_x_mm", "tip_y_mm", "tip_z_mm", "torque x", "torque y", "Normalkraft (N)"),
}
WRITTEN = {
    "commas": {},
    "semicolons, decimal commas": {"sep": ";", "decimal": ","},
    "tabs, decimal commas": {"sep": "\t", "decimal": ","},
    "spaces": {"sep": " "},
    "bars": {"sep": "|"},
    "utf-16": {"encoding": "utf-16"},
}


def probes(names: str = "plain") -> pd.DataFrame:
    """Return 36 probes to 3 mm of a flat body, in millimetres, with a stiff place; the columns have these names."""
    rng = np.random.default_rng(0)
    x, y, step = (a.ravel() for a in np.meshgrid(np.arange(6) * 5.0, np.arange(6) * 5.0, np.arange(10), indexing="ij"))
    force = (1 + (np.hypot(x - 10, y - 10) < 6)) * (step / 9) ** 1.5 + rng.normal(0, 0.01, len(x))
    side = rng.normal(0, 0.01, (2, len(x)))
    columns = np.column_stack((np.repeat(np.arange(36), 10), x, y, -step / 3, *side, force))
    return pd.DataFrame(columns).astype({0: int}).set_axis(list(HEADERS[names]), axis=1)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "probes.csv"


def proposed(file: Path, table: pd.DataFrame) -> tuple[list[str], Path]:
    """Return the lines and the file of the mapping that is proposed for a table, which is written to `file`."""
    table.to_csv(file, index=False)
    return propose(file, file.with_name("mapping.yaml")), file.with_name("mapping.yaml")


@pytest.mark.parametrize("writer", HEADERS)
def test_columns_and_units_are_recognised_by_their_names(writer: str, file: Path) -> None:
    names = HEADERS[writer]
    lines, written = proposed(file, probes(writer))
    mapping = read_mapping(written)
    assert mapping.table is not None
    forces = names[4:] if "torque x" not in names else names[6:]
    assert (mapping.table.position, mapping.table.force, mapping.table.probe) == (names[1:4], forces, names[0])
    assert (mapping.units.length, mapping.units.force) == ("mm", "N")
    assert any("36 contacts to 3" in line for line in lines)
    assert any("not sure: units.force" in line for line in lines) == ("N" not in names[6])
    assert len(read_recording(file, mapping).touches) == 36


def test_probes_may_have_names_and_yaml_takes_on_for_true(file: Path) -> None:
    table = probes()
    table[["fx", "fy", "fz"]] *= -1
    table.assign(probe="P" + table.probe.astype(str)).to_csv(file, index=False)
    file.with_name("mapping.yaml").write_text(
        "table: {position: [x, y, z], force: [fx, fy, fz], probe: probe}\nunits: {length: mm}\n"
        "force: {on: body}\ntool: {radius_m: 0.01}\n"
    )
    recording = read_recording(file, file.with_name("mapping.yaml"))
    assert len(recording.touches) == 36
    assert not recording.faults


def test_the_sign_of_a_single_column_of_force_is_proposed_and_used(file: Path) -> None:
    table = probes("one force")
    table[table.columns[-1]] *= -1
    mapping = read_mapping(proposed(file, table)[1])
    assert mapping.force.on == "body"
    assert not read_recording(file, mapping).faults


@pytest.mark.parametrize(("wide", "deep"), [(12, 1), (1, 20)], ids=["60 mm apart", "60 mm deep"])
def test_sizes_that_no_examination_allows_have_a_scenario(file: Path, wide: float, deep: float) -> None:
    table = probes()
    table[["x", "y"]] *= wide
    table[["z", "fz"]] *= deep
    mapping = read_mapping(proposed(file, table)[1])
    ball = mapping.tool.model_copy(update={"radius_m": 0.01 * max(1.0, 0.1 * deep)})
    recording = read_recording(file, mapping.model_copy(update={"tool": ball}))
    assert recording.touches
    exam = scenario_of(recording).exam
    assert exam.depth_m == pytest.approx(np.clip(recording.depth_m, 0.0002, 0.05))
    assert exam.spacing_m == pytest.approx(min(0.005 * wide, 0.05), rel=0.1)


@pytest.mark.parametrize(("scale", "printed"), [(1.0, False), (1 / 9.80665, True)])
def test_forces_that_may_be_in_kgf_are_named(file: Path, scale: float, printed: bool) -> None:
    table = probes()
    table[["fx", "fy", "fz"]] *= scale
    assert any("if the forces are in kgf" in line for line in proposed(file, table)[0]) is printed


@pytest.mark.parametrize("written", WRITTEN.values(), ids=WRITTEN)
def test_tables_of_any_separator_are_read(written: dict[str, str], file: Path) -> None:
    probes().to_csv(file, index=False, **written)
    pd.testing.assert_frame_equal(read_table(file), probes(), check_dtype=False)


def test_a_separator_at_the_end_of_each_row_moves_no_column(file: Path) -> None:
    probes().to_csv(file, index=False, lineterminator=",\n")
    file.write_text(file.read_text().replace("fz,\n", "fz\n"))
    assert np.array_equal(read_table(file).x, probes().x)


@pytest.mark.parametrize("name", ["", ".data", "a/b\x01", "x" * 101], ids=["none", "dot", "control character", "long"])
def test_any_name_of_a_file_has_a_scenario(name: str, file: Path) -> None:
    recording = read_recording(file, proposed(file, probes())[1])
    assert len(scenario_of(replace(recording, name=name)).name) in range(1, 101)


def test_times_of_any_origin_begin_at_zero(file: Path) -> None:
    table = probes().assign(t=3.9e9 + np.arange(360) * 0.01)
    times = readings.from_table(table, read_mapping(proposed(file, table)[1]), "a").time
    assert times == pytest.approx(np.arange(360) * 0.01, abs=1e-6)


def test_equal_texts_of_a_table_are_kept_once(tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    table = probes().assign(note="x" * 1000, probe="P" + probes().probe.astype(str))
    table.to_parquet(tmp_path / "a.parquet")
    assert read_table(tmp_path / "a.parquet").memory_usage(deep=True).note < 10_000
    mapping = read_mapping(proposed(tmp_path / "a.csv", table)[1])
    assert len(read_recording(tmp_path / "a.parquet", mapping).touches) == 36


@pytest.mark.parametrize("suffix", ["csv", "parquet"])
def test_a_table_of_more_rows_than_allowed_is_refused(suffix: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("pyarrow")
    probes().to_csv(tmp_path / "a.csv", index=False)
    probes().to_parquet(tmp_path / "a.parquet")
    monkeypatch.setattr(readings, "bounds", lambda: Bounds(elements=100))
    with pytest.raises(UserError, match=r"rows; allowed: 100|elements"):
        read_table(tmp_path / f"a.{suffix}")


def test_a_recording_without_a_map_has_a_report_and_status_2(file: Path, tmp_path: Path) -> None:
    _, mapping = proposed(file, probes().iloc[:20])
    words = ["assess", str(file), "--mapping", str(mapping), "--out", str(tmp_path / "results")]
    called = CliRunner().invoke(app_for("assess"), words)
    assert called.exit_code == ExitStatus.BAD_INPUT
    assert "2 of 2 contacts lie on one line" in called.output
    assert "lie on one line" in (tmp_path / "results" / "report.html").read_text()


@pytest.mark.parametrize(
    ("table", "text"),
    [
        (probes().iloc[:0], "no numbers"),
        (probes().iloc[:1], "1 usable rows"),
        (probes().assign(q0=90.0, q1=0.0, q2=10.0, q3=0.0), r"norm is 90\.6"),
    ],
    ids=["header", "one row", "an orientation in degrees"],
)
def test_an_unusable_table_is_refused_in_one_line(table: pd.DataFrame, text: str, file: Path) -> None:
    with pytest.raises(UserError, match=text):
        proposed(file, table)


FOLDER = Path(os.environ.get("PALPATE_RECORDINGS", "missing"))
EXAMPLES = Path(__file__).resolve().parents[2] / "docs" / "examples"
KNOWN = {
    "vessel-at-2-mm": ("probingRAL2018_T1.csv", "probes", (-6, 45), 8, 1),
    "vessel-at-3-mm": ("probingRAL2018_T2.csv", "probes", (-6, 45), 8, 1),
    "ball": ("region_small_balls.csv", "probes", (-30.5, 65), 3, 1),
    "vessel-in-a-slide": ("ContPalpRAL18T1.csv", "slide", (1, -13), 6, 1),
    "liver": ("pig_liver_20150826_region1.csv", "probes", None, 0, 0),
    "liver-to-3-mm": ("pig_liver_20150826_v2_region1.csv", "probes", None, 0, 0),
}


@pytest.mark.parametrize(("name", "mapping", "place_mm", "near_mm", "most"), KNOWN.values(), ids=KNOWN)
def test_a_real_body_gives_what_is_known_of_it(
    name: str, mapping: str, place_mm: tuple[float, float] | None, near_mm: float, most: int
) -> None:
    if not (FOLDER / name).is_file():
        pytest.skip("PALPATE_RECORDINGS has no such recording")
    recording = read_recording(FOLDER / name, EXAMPLES / f"{mapping}.yaml")
    found = assess(recording)
    places = 1e3 * found.findings[["x_m", "y_m"]].to_numpy(float)
    assert len(places) <= most
    if place_mm is not None:
        assert np.linalg.norm(places - place_mm, axis=1).min() < near_mm
    assert found.map.background == pytest.approx(float(np.median([sample.force for sample in recording.samples()])), rel=0.05)
