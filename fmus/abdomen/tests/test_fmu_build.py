"""Building the FMU: archive, platforms and the command."""

import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import fmpy
import numpy as np
import pytest
from typer.testing import CliRunner

from palpate.commands import app_for
from palpate_fmu.compiling import WARNINGS, native, platforms
from palpate_fmu.export import ExportError, build_fmu, sizes_of, start_values, write_sources
from palpate_fmu.instance import FmuInstance
from palpate_fmu.probing import probe
from palpate_models.patient.phantom import build_phantom
from palpate_models.patient.schema import Lesion, Phantom, Stiffness

HERE = Path(__file__).parent
STRICT = (*WARNINGS, "-Wshadow", "-Wconversion")
# A second compiler where there is one; zig's, which has no address sanitizer, elsewhere.
OTHER = ["gcc"] if shutil.which("gcc") else [sys.executable, "-m", "ziglang", "cc"]
SANITIZERS = "address,undefined" if shutil.which("gcc") else "undefined"


def test_the_same_phantom_gives_the_same_bytes(fmu3: Path, phantom: Phantom, tmp_path: Path) -> None:
    again = build_fmu(phantom, 1, tmp_path / "again.fmu", 3, [native()])
    assert again.read_bytes() == fmu3.read_bytes()
    other = build_fmu(phantom, 2, tmp_path / "other.fmu", 3, [native()])
    tokens = {fmpy.read_model_description(str(path)).instantiationToken for path in (again, other)}
    assert len(tokens) == 2


def test_what_does_not_fit_is_said(tmp_path: Path) -> None:
    many = Phantom(lesions=tuple(Lesion(centre_m=(0.0, 0.01 * k)) for k in range(9)), edge_m=0.015)
    with pytest.raises(ExportError, match=r"phantom\.lesions has 9 entries"):
        build_fmu(many, 0, tmp_path / "x.fmu", 3, [native()])
    slow = Phantom(stiffness=Stiffness(prony_g=(0.1,), prony_tau_s=(1e9,)), edge_m=0.015)
    with pytest.raises(ExportError, match="prony_tau"):
        build_fmu(slow, 0, tmp_path / "x.fmu", 3, [native()])
    with pytest.raises(ValueError, match="FMI 2 has no platform 'aarch64-linux'"):
        build_fmu(Phantom(), 0, tmp_path / "x.fmu", 2, ["aarch64-linux"])


def test_the_sources_in_the_fmu_build_with_another_compiler(fmu2: Path, tmp_path: Path) -> None:
    folder = Path(fmpy.extract(str(fmu2), unzipdir=str(tmp_path / "unpacked")))
    description = fmpy.read_model_description(str(folder))
    names = description.buildConfigurations[0].sourceFileSets[0].sourceFiles
    library = next((folder / "binaries").rglob("abdomen.*"))
    library.unlink()
    command = [*OTHER, *STRICT, "-O1", "-fPIC", "-shared", "-o", str(library), *names, "-lm"]
    subprocess.run(command, cwd=folder / "sources", check=True)
    rebuilt = Path(shutil.make_archive(str(tmp_path / "rebuilt"), "zip", folder))
    with FmuInstance(rebuilt) as theirs, FmuInstance(fmu2) as ours:
        found, expected = probe(theirs, hold_s=0.1), probe(ours, hold_s=0.1)
    scale = np.abs(expected).max(axis=0)
    np.testing.assert_allclose(found / scale, expected / scale, atol=1e-9)


def test_sanitizers_find_nothing(fmu: Path, phantom: Phantom, tmp_path: Path) -> None:
    folder = Path(fmpy.extract(str(fmu), unzipdir=str(tmp_path / "unpacked")))
    description = fmpy.read_model_description(str(fmu))
    version = int(description.fmiVersion[0])
    names = write_sources(tmp_path / "c", version)
    sanitizers = [f"-fsanitize={SANITIZERS}", "-fno-sanitize-recover=all", "-fno-omit-frame-pointer"]
    command = [*OTHER, *STRICT, "-O1", "-g", *sanitizers, f"-DFMI_VERSION={version}", "-I.", "-o", str(tmp_path / "exercise")]
    subprocess.run([*command, str(HERE / "exercise.c"), *names, "-lm"], cwd=tmp_path / "c", check=True)

    def exercise(*sizes: int) -> None:
        words = [str(tmp_path / "exercise"), str(folder / "resources"), description.guid, *map(str, sizes)]
        environment = {**os.environ, "ASAN_OPTIONS": "detect_leaks=1"}
        done = subprocess.run(words, capture_output=True, text=True, check=False, env=environment)
        assert done.returncode == 0, done.stdout + done.stderr

    sizes = sizes_of(build_phantom(phantom, 1), start_values(phantom, 0.015))
    exercise(sizes.vertices, sizes.triangles)
    rng = np.random.default_rng(version)
    file = folder / "resources" / "phantom.bin"
    whole = file.read_bytes()
    for _ in range(20):
        damaged = bytearray(whole)
        for at in np.concatenate((rng.integers(72, 116, rng.integers(2)), rng.integers(120, len(whole), 40))):
            damaged[at] = rng.integers(256)
        file.write_bytes(damaged[: rng.choice((len(whole), rng.integers(len(whole))), p=(0.8, 0.2))])
        exercise()


@pytest.mark.slow
@pytest.mark.parametrize("version", [2, 3])
def test_it_compiles_for_every_platform(version: int, tmp_path: Path) -> None:
    path = build_fmu(Phantom(edge_m=0.015), 0, tmp_path / "all.fmu", version)
    magic = {".so": b"\x7fELF", ".dll": b"MZ", ".dylib": b"\xcf\xfa\xed\xfe"}
    with zipfile.ZipFile(path) as archive:
        found = [name for name in archive.namelist() if name.startswith("binaries/")]
        for name in found:
            library = archive.read(name)
            assert library.startswith(magic[Path(name).suffix]), name
            assert f"fmi{version}DoStep".encode() in library, name
    assert len(found) == len(platforms(version)) == (3 if version == 2 else 6)


runner = CliRunner()
BUILD = ("build", "healthy", "--platform", native(), "--set", "phantom.edge_m=0.01", "--set", "phantom.breathing.kind=none")


def fmu_command(*words: object, status: int = 0) -> str:
    done = runner.invoke(app_for("fmu"), ["fmu", *map(str, words)])
    assert done.exit_code == status, done.output
    return done.output.replace("\n", " ") if status else done.output


def test_build_info_and_simulate(tmp_path: Path) -> None:
    path, plot = tmp_path / "a.fmu", tmp_path / "a.png"
    assert len(fmu_command(*BUILD, "-o", path).splitlines()) == 1  # no bar where there is no terminal
    assert fmu_command(*BUILD, "-o", path, "--quiet") == ""
    shown = fmu_command("info", path)
    words = ("abdomen", "FMI 3.0, coSimulation, modelExchange", native(), "indenter_position", "m/s", "-10.0 .. 10.0", "valid")
    assert all(word in shown for word in words), shown
    fmu_command("simulate", path, "-o", plot, "--depth", "0.008", "--at", "0.02", "-0.03")
    assert plot.read_bytes().startswith(b"\x89PNG")
    table = np.loadtxt(plot.with_suffix(".csv"), delimiter=",", skiprows=1)
    assert 0.5 < table[:, 2].max() < 5
    assert table[:, 1].max() == pytest.approx(0.008, abs=1e-4)


def test_a_mesh_is_a_phantom(tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    mesh, path = tmp_path / "ball.stl", tmp_path / "ball.fmu"
    trimesh.creation.icosphere(subdivisions=3, radius=0.03).apply_translation((0, 0, -0.03)).export(mesh)
    fmu_command("build", mesh, "-o", path, "--platform", native(), "--fmi", 2)
    fmu_command("simulate", path, "-o", tmp_path / "ball.png", "--at", 0.01, 0.0)


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
    said = fmu_command(*arguments, status=2)
    assert all(word in said for word in words), said


FOREIGN = """<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="{}" modelName="one" modelIdentifier="one" guid="g"><CoSimulation modelIdentifier="one"/>
<ModelVariables><ScalarVariable name="touching" valueReference="7" causality="output"><Boolean/></ScalarVariable></ModelVariables>
<ModelStructure/></fmiModelDescription>"""


@pytest.mark.parametrize(
    ("version", "status", "words"),
    [("2.0", 0, ("platforms: linux64", "do not prevent its use", "touching")), ("1.0", 2, ("FMI 1.0; expected 2.0 or 3.0",))],
)
def test_info_shows_what_a_strangers_fmu_is(version: str, status: int, words: tuple[str, ...], tmp_path: Path) -> None:
    path = tmp_path / "one.fmu"
    with zipfile.ZipFile(path, "w") as archive:
        for folder in ("binaries/", "binaries/linux64/", "binaries/win64/"):
            archive.writestr(folder, "")  # as zip tools write them
        archive.writestr("binaries/linux64/one.so", "")
        archive.writestr("modelDescription.xml", FOREIGN.format(version))
    shown = fmu_command("info", path, status=status)
    assert all(word in shown for word in words), shown
