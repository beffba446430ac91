"""`palpate fmu` as users type it."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from palpate.fmu import app
from palpate_fmu.compiling import native
from palpate_fmu.running import run_and_plot

runner = CliRunner()
BUILD = ("build", "healthy", "--platform", native(), "--set", "phantom.edge_m=0.01", "--set", "phantom.breathing.kind=none")


def test_build_info_and_simulate(tmp_path: Path) -> None:
    path = tmp_path / "a.fmu"
    built = runner.invoke(app, [*BUILD, "-o", str(path)])
    assert built.exit_code == 0, built.output
    assert len(built.output.splitlines()) == 1  # no bar where there is no terminal
    silent = runner.invoke(app, [*BUILD, "-o", str(path), "--quiet"])
    assert (silent.exit_code, silent.output) == (0, "")
    shown = runner.invoke(app, ["info", str(path)])
    assert shown.exit_code == 0
    kinds = "FMI 3.0, coSimulation, modelExchange"
    for word in (
        "abdomen",
        kinds,
        native(),
        "indenter_position",
        "m/s",
        "-10.0 .. 10.0",
        "valid",
        "continuous states",
        "FMPy's CVode",
    ):
        assert word in shown.output
    plot = tmp_path / "a.png"
    probed = runner.invoke(app, ["simulate", str(path), "-o", str(plot), "--depth", "0.008", "--at", "0.02", "-0.03"])
    assert probed.exit_code == 0, probed.output
    assert plot.read_bytes().startswith(b"\x89PNG")
    table = np.loadtxt(plot.with_suffix(".csv"), delimiter=",", skiprows=1)
    assert 0.5 < table[:, 2].max() < 5
    assert table[:, 1].max() == pytest.approx(0.008, abs=1e-4)


def test_a_mesh_is_a_phantom(tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    mesh = tmp_path / "ball.stl"
    trimesh.creation.icosphere(subdivisions=4, radius=0.15).apply_translation((0, 0, -0.15)).export(mesh)
    path = tmp_path / "ball.fmu"
    built = runner.invoke(app, ["build", str(mesh), "-o", str(path), "--platform", native(), "--fmi", "2"])
    assert built.exit_code == 0, built.output
    probed = runner.invoke(app, ["simulate", str(path), "-o", str(tmp_path / "ball.png"), "--at", "0.01", "0.0"])
    assert probed.exit_code == 0, probed.output


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["build", "no_such"], ("no_such", "clean")),
        (["build", "healthy", "--platform", "sparc"], ("sparc", "x86_64-linux")),
        (["build", "healthy", "--set", "phantom.edge_m=1"], ("phantom.edge_m",)),
        (["build", "missing.stl"], ("missing.stl",)),
        (["info", __file__], ("not an FMU",)),
        (["simulate", __file__], ("not an FMU",)),
    ],
)
def test_bad_input_ends_with_status_2_and_says_what_is_wrong(arguments: list[str], words: tuple[str, ...]) -> None:
    done = runner.invoke(app, arguments)
    assert done.exit_code == 2, done.output
    for word in words:
        assert word in done.output.replace("\n", " ")


def test_any_fmu_is_run_and_plotted(fmu2: Path, tmp_path: Path) -> None:
    names = run_and_plot(fmu2, tmp_path / "x.png")
    assert "normal_force" in names
    assert (tmp_path / "x.png").stat().st_size > 5000


FOREIGN = """<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="{}" modelName="one" modelIdentifier="one" guid="g"><CoSimulation modelIdentifier="one"/>
<ModelVariables><ScalarVariable name="touching" valueReference="7" causality="output"><Boolean/></ScalarVariable></ModelVariables>
<ModelStructure/></fmiModelDescription>"""


@pytest.mark.parametrize(
    ("version", "status", "words"),
    [("2.0", 0, ("platforms: linux64", "do not prevent its use", "touching")), ("1.0", 2, ("FMI 1.0; want 2.0 or 3.0",))],
)
def test_info_shows_what_a_strangers_fmu_is(version: str, status: int, words: tuple[str, ...], tmp_path: Path) -> None:
    path = tmp_path / "one.fmu"
    with zipfile.ZipFile(path, "w") as archive:
        for folder in ("binaries/", "binaries/linux64/", "binaries/win64/"):
            archive.writestr(folder, "")  # as zip tools write them
        archive.writestr("binaries/linux64/one.so", "")
        archive.writestr("modelDescription.xml", FOREIGN.format(version))
    shown = runner.invoke(app, ["info", str(path)])
    assert shown.exit_code == status, shown.output
    for word in words:
        assert word in shown.output
