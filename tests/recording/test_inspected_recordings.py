"""Proposed mappings: tables of many writers."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner

from palpate.commands import app_for
from palpate.recording.inspect import propose
from palpate.recording.mapping import read_mapping
from palpate.recording.read import read_recording
from palpate.recording.readings import read_table
from palpate_errors import ExitStatus, UserError

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


@pytest.mark.parametrize("writer", HEADERS)
def test_columns_and_units_are_recognised_by_their_names(writer: str, tmp_path: Path) -> None:
    names = HEADERS[writer]
    probes(writer).to_csv(tmp_path / "probes.csv", index=False)
    lines = propose(tmp_path / "probes.csv", tmp_path / "mapping.yaml")
    mapping = read_mapping(tmp_path / "mapping.yaml")
    assert mapping.table is not None
    assert mapping.table.position == names[1:4]
    assert mapping.table.force == (names[4:] if "torque x" not in names else names[6:])
    assert mapping.table.probe == names[0]
    assert (mapping.units.length, mapping.units.force) == ("mm", "N")
    assert any("36 contacts to 3" in line for line in lines)
    assert ("not sure: units.force: N; the table has no unit" in lines) == ("N" not in names[6])
    assert len(read_recording(tmp_path / "probes.csv", mapping).touches) == 36


def test_probes_may_have_names_and_yaml_takes_on_for_true(tmp_path: Path) -> None:
    table = probes()
    table.assign(probe="P" + table.probe.astype(str), **{name: -table[name] for name in ("fx", "fy", "fz")}).to_csv(
        tmp_path / "probes.csv", index=False
    )
    (tmp_path / "mapping.yaml").write_text(
        "table: {position: [x, y, z], force: [fx, fy, fz], probe: probe}\nunits: {length: mm}\n"
        "force: {on: body}\ntool: {radius_m: 0.01}\n"
    )
    recording = read_recording(tmp_path / "probes.csv", tmp_path / "mapping.yaml")
    assert len(recording.touches) == 36
    assert not recording.faults


def test_forces_that_may_be_in_kgf_are_named(tmp_path: Path) -> None:
    table = probes()
    for scale, printed in ((1.0, False), (1 / 9.80665, True)):
        table.assign(**{name: scale * table[name] for name in ("fx", "fy", "fz")}).to_csv(tmp_path / "probes.csv", index=False)
        lines = propose(tmp_path / "probes.csv", tmp_path / "mapping.yaml")
        assert any("if the forces are in kgf" in line for line in lines) is printed


@pytest.mark.parametrize("written", WRITTEN.values(), ids=WRITTEN)
def test_tables_of_any_separator_are_read(written: dict[str, str], tmp_path: Path) -> None:
    table = probes()
    table.to_csv(tmp_path / "probes.csv", index=False, **written)
    pd.testing.assert_frame_equal(read_table(tmp_path / "probes.csv"), table, check_dtype=False)


def test_a_separator_at_the_end_of_each_row_moves_no_column(tmp_path: Path) -> None:
    table = probes()
    table.to_csv(tmp_path / "probes.csv", index=False, lineterminator=",\n")
    text = (tmp_path / "probes.csv").read_text()
    (tmp_path / "probes.csv").write_text(text.replace("fz,\n", "fz\n"))
    assert np.array_equal(read_table(tmp_path / "probes.csv").x, table.x)


def test_a_recording_without_a_map_has_a_report_and_status_2(tmp_path: Path) -> None:
    probes().iloc[:20].to_csv(tmp_path / "probes.csv", index=False)
    propose(tmp_path / "probes.csv", tmp_path / "mapping.yaml")
    table, mapping, out = (str(tmp_path / name) for name in ("probes.csv", "mapping.yaml", "results"))
    called = CliRunner().invoke(app_for("assess"), ["assess", table, "--mapping", mapping, "--out", out])
    assert called.exit_code == ExitStatus.BAD_INPUT
    assert "2 of 2 contacts lie on one line" in called.output
    assert "lie on one line" in (tmp_path / "results" / "report.html").read_text()


@pytest.mark.parametrize("rows", [0, 1], ids=["header", "one row"])
def test_too_few_rows_are_one_line(rows: int, tmp_path: Path) -> None:
    probes().iloc[:rows].to_csv(tmp_path / "probes.csv", index=False)
    with pytest.raises(UserError, match=r"no numbers|1 usable rows"):
        propose(tmp_path / "probes.csv", tmp_path / "mapping.yaml")


def test_an_orientation_in_degrees_is_no_quaternion(tmp_path: Path) -> None:
    table = probes().assign(q0=90.0, q1=0.0, q2=10.0, q3=0.0)
    table.to_csv(tmp_path / "probes.csv", index=False)
    with pytest.raises(UserError, match=r"norm is 90\.6"):
        propose(tmp_path / "probes.csv", tmp_path / "mapping.yaml")
