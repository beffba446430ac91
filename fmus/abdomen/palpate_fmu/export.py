"""Writing the abdomen as an FMU: model description, phantom, sources and binaries for every platform."""

import shutil
import tempfile
import uuid
import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path

from palpate_fmu.compiling import compile_library, fmi_headers, platforms
from palpate_fmu.description import MODEL, SOURCES, build_description, description_2, description_3, documentation
from palpate_fmu.phantom_file import encode_phantom, sizes_of, start_values
from palpate_fmu.variables import c_table
from palpate_models.patient.breathing import BreathingCurve
from palpate_models.patient.person import drawn
from palpate_models.patient.phantom import PhantomModel, build_phantom
from palpate_models.patient.schema import Phantom
from palpate_models.scenario.schema import Scenario

_NAMESPACE = uuid.UUID("6f1f5a0e-6a0c-5c7e-9a39-0d9b5c1f4a11")
_EPOCH = (2020, 1, 1, 0, 0, 0)
"""Date of every file in the archive, so that the same phantom gives the same bytes."""


def source_folder() -> Path:
    """Return the C sources, in a wheel or in a checkout."""
    here = Path(__file__).resolve().parent
    packaged = here / "src"
    return packaged if packaged.is_dir() else here.parent / "src"


def write_sources(folder: Path, version: int) -> tuple[str, ...]:
    """Copy the sources of an FMI version, with the generated table and the standard's headers; return what to compile."""
    folder.mkdir(parents=True, exist_ok=True)
    names = (f"fmi{version}.c", *SOURCES)
    for path in (*(source_folder() / name for name in names), *source_folder().glob("*.h")):
        shutil.copyfile(path, folder / path.name)
    for path in fmi_headers().glob(f"fmi{version}*.h"):
        shutil.copyfile(path, folder / path.name)
    (folder / "variables.h").write_text(c_table(), encoding="utf-8")
    return names


def build_fmu(
    phantom: Phantom,
    seed: int,
    out: Path,
    version: int = 3,
    targets: Sequence[str] | None = None,
    radius_m: float = 0.015,
    model: PhantomModel | None = None,
    compiling: Callable[[str], None] = lambda _: None,
) -> Path:
    """Write the FMU of a phantom to `out` and return that path.

    `version` is FMI's, 2 or 3; `targets` are platforms by FMI 3.0's names, all by default; `radius_m` is the indenter's
    start value; `model` replaces the surface and background that `phantom` would give; `compiling` is called with each platform
    before it is compiled for. The same arguments give the same bytes. Raises ExportError, CompileError or ValueError.
    """
    if version not in (2, 3):
        raise ValueError(f"FMI version {version} is not one of 2, 3")
    wanted = platforms(version, targets)
    phantom = drawn(phantom, seed)
    model = model or build_phantom(phantom, seed)
    starts = start_values(phantom, radius_m)
    sizes = sizes_of(model, starts)
    breaths = BreathingCurve(phantom.breathing, seed).table
    token = _token(encode_phantom(model, breaths, starts, ""), version)
    about = f"Soft abdomen, {sizes.vertices} vertices, pressed by a sphere; abdomen frame (x left, y head, z outward), SI units"
    if version == 3:
        description = description_3(token, about, starts, sizes)
    else:
        description = description_2(token, about, starts, sizes, model)
    with tempfile.TemporaryDirectory() as work:
        folder = Path(work) / "sources"
        names = write_sources(folder, version)
        if version == 3:
            (folder / "buildDescription.xml").write_bytes(build_description())
        files = {
            "modelDescription.xml": description,
            "documentation/index.html": documentation(version, about, sizes),
            "resources/phantom.bin": encode_phantom(model, breaths, starts, token),
            **{f"sources/{path.name}": path.read_bytes() for path in sorted(folder.iterdir())},
        }
        for target in wanted:
            place = target.tuple_3 if version == 3 else target.folder_2
            compiling(target.tuple_3)
            files[f"binaries/{place}/{MODEL}{target.suffix}"] = compile_library(folder, names, target)
    out.parent.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED, compresslevel=6) as archive:
        for name, content in files.items():
            entry = zipfile.ZipInfo(name, _EPOCH)
            entry.compress_type = zipfile.ZIP_DEFLATED
            entry.external_attr = 0o644 << 16
            archive.writestr(entry, content)
    return out


def build_scenario_fmu(
    scenario: Scenario,
    out: Path,
    version: int = 3,
    targets: Sequence[str] | None = None,
    compiling: Callable[[str], None] = lambda _: None,
) -> Path:
    """`build_fmu` for the phantom and the indenter of a scenario."""
    return build_fmu(scenario.phantom, scenario.seed, out, version, targets, scenario.robot.indenter_radius_m, None, compiling)


def _token(content: bytes, version: int) -> str:
    """Return the instantiation token: of the phantom, the sources and the FMI version."""
    parts = [path.read_bytes() for path in sorted(source_folder().glob("*.[ch]"))]
    digest = uuid.uuid5(_NAMESPACE, f"{version} {c_table()} {[part.hex() for part in parts]} {content.hex()}")
    return f"{{{digest}}}"
