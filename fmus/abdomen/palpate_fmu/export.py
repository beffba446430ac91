"""Writing the abdomen as an FMU: model description, phantom, sources and binaries for every platform."""

import shutil
import struct
import tempfile
import uuid
import zipfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import chain, product
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
from numpy.typing import NDArray

from palpate_errors import UserError
from palpate_fmu.compiling import compile_library, fmi_headers, platforms
from palpate_fmu.variables import (
    BRANCHES,
    LESIONS,
    STEP_S,
    Sizes,
    Variable,
    VariableKind,
    VariableRole,
    c_table,
    parameters,
    variables,
)
from palpate_models.numerics.frames import Array
from palpate_models.patient.field import at_skin
from palpate_models.patient.motion import BreathingCurve
from palpate_models.patient.person import draw_person
from palpate_models.patient.phantom import PhantomModel, build_phantom
from palpate_models.patient.schema import Phantom
from palpate_models.scenario.schema import Scenario


def couplings(model: PhantomModel) -> tuple[NDArray[np.intp], ...]:
    """For every vertex, those whose displacement moves it, itself included; none for one that is fixed."""
    pattern = model.laplacian.tocsr()
    rows = np.split(pattern.indices, pattern.indptr[1:-1])
    return tuple(
        np.empty(0, dtype=np.intp) if fixed else np.union1d(row[~model.fixed[row]], [i]).astype(np.intp)
        for i, (fixed, row) in enumerate(zip(model.fixed, rows, strict=True))
    )


def _unknowns(table: Sequence[Variable]) -> tuple[list[Variable], list[Variable], list[Variable]]:
    """Outputs, derivatives of states, and all that initialization calculates."""
    outputs = [v for v in table if v.role is VariableRole.OUTPUT and not v.settable]
    rates = [v for v in table if v.rate_of]
    return outputs, rates, [*outputs, *rates, *(v for v in table if v.role is VariableRole.CALCULATED and not v.settable)]


def structure_3(root: ET.Element, sizes: Sizes) -> None:
    """ModelStructure of FMI 3.0, by value references of arrays."""
    structure = ET.SubElement(root, "ModelStructure")
    names = ("Output", "ContinuousStateDerivative", "InitialUnknown")
    for name, members in zip(names, _unknowns(variables(3, sizes)), strict=True):
        for variable in members:
            ET.SubElement(structure, name, valueReference=str(variable.vr))


class Indices:
    """Places of FMI 2.0's scalars in ModelVariables, from 1."""

    def __init__(self, table: Sequence[Variable], sizes: Sizes) -> None:
        self._sizes = sizes
        self._first: dict[str, int] = {}
        used = 1
        for variable in table:
            self._first[variable.name] = used
            used += variable.count(sizes)

    def of(self, variable: Variable) -> range:
        """Return the places of all elements of a variable."""
        first = self._first[variable.name]
        return range(first, first + variable.count(self._sizes))

    def at(self, name: str, elements: Iterable[int]) -> Iterator[int]:
        """Return the places of some elements, counted from 0, of a variable."""
        return (self._first[name] + int(k) for k in elements)


def _dependencies(variable: Variable, indices: Indices, sizes: Sizes, model: PhantomModel) -> Iterator[Iterable[int] | None]:
    """Return the dependencies of each element; None: all."""
    n = sizes.vertices
    if variable.rate_of == "displacement":
        for near, tension in zip(couplings(model), model.tension, strict=True):
            own = indices.at("displacement", near)
            relaxed = (indices.at("relaxation", k * n + near) for k in range(sizes.branches))
            outside = (*indices.at("time", [0]), *indices.at("indenter_position", range(3))) if len(near) else ()
            muscle = indices.at("activation", [0]) if len(near) and tension else ()
            yield chain(outside, own, *relaxed, muscle)
    elif variable.rate_of == "relaxation":
        for k in range(sizes.branches * n):
            yield chain(indices.at("displacement", [k % n]), indices.at("relaxation", [k]))
    elif variable.name == "sample_displacement":
        for vertex in sample_vertices(model):
            yield chain(indices.at("time", [0]), indices.at("displacement", [vertex]))
    else:
        yield from (None for _ in indices.of(variable))


def structure_2(root: ET.Element, sizes: Sizes, model: PhantomModel) -> None:
    """ModelStructure of FMI 2.0, by places of scalars in ModelVariables, with the sparsity of the states' derivatives."""
    table = variables(2, sizes)
    indices = Indices(table, sizes)
    structure = ET.SubElement(root, "ModelStructure")
    names = ("Outputs", "Derivatives", "InitialUnknowns")
    for name, members in zip(names, _unknowns(table), strict=True):
        group = ET.SubElement(structure, name)
        places: dict[int, Iterable[int] | None] = {}
        for variable in members:
            of_elements = _dependencies(variable, indices, sizes, model)
            places |= dict(zip(indices.of(variable), of_elements, strict=True))
        for place in sorted(places) if name == "InitialUnknowns" else places:
            unknown = ET.SubElement(group, "Unknown", index=str(place))
            known = None if name == "InitialUnknowns" else places[place]
            if known is not None:
                unknown.set("dependencies", " ".join(map(str, known)))


MODEL = "abdomen"
"""The model identifier: name of binaries and prefix of functions."""
SOURCES = (
    "breath.c", "component.c", "contact.c", "derivative.c", "exchange.c", "flow.c", "guarding.c",
    "matrices.c", "outputs.c", "phantom.c", "surface.c", "tissue.c",
)  # fmt: skip

UNITS: dict[str, dict[str, str]] = {
    "1": {},
    "s": {"s": "1"},
    "1/s": {"s": "-1"},
    "m": {"m": "1"},
    "m/s": {"m": "1", "s": "-1"},
    "rad/s": {"rad": "1", "s": "-1"},
    "1/m": {"m": "-1"},
    "N": {"kg": "1", "m": "1", "s": "-2"},
    "N.m": {"kg": "1", "m": "2", "s": "-2"},
    "N/m3": {"kg": "1", "m": "-2", "s": "-2"},
    "J": {"kg": "1", "m": "2", "s": "-2"},
}


def _causality(variable: Variable) -> dict[str, str]:
    """Causality, variability and initial, where they are not FMI's defaults."""
    if variable.role is VariableRole.INDEPENDENT and variable.kind is VariableKind.READ:
        return {"causality": "independent", "variability": "continuous"}
    if variable.kind is VariableKind.INPUT:
        return {"causality": "input", "variability": "continuous"}
    if variable.parameter:
        fixed = variable.kind is VariableKind.FIXED
        return {"causality": "parameter", "variability": "fixed" if fixed else "tunable", "initial": "exact"}
    if variable.kind is VariableKind.STATE:
        return {"causality": "local", "variability": "continuous", "initial": "exact"}
    if variable.role is VariableRole.CALCULATED:
        return {"causality": "calculatedParameter", "variability": "fixed", "initial": "calculated"}
    continuous = "discrete" if variable.integer else "continuous"
    return {"causality": str(variable.role), "variability": continuous, "initial": "calculated"}


def _number(value: float, integer: bool) -> str:
    return str(int(value)) if integer else repr(float(value))


def _type_attributes(variable: Variable) -> dict[str, str]:
    attributes = {} if variable.unit is None else {"unit": variable.unit}
    for name, bound in (("min", variable.low), ("max", variable.high), ("nominal", variable.nominal)):
        if bound is not None:
            attributes[name] = _number(bound, variable.integer)
    return attributes


def _start(variable: Variable, starts: Mapping[str, Array], sizes: Sizes) -> Array | None:
    if variable.name in starts:
        return starts[variable.name]
    if not variable.settable:
        return None
    return np.broadcast_to(np.asarray(variable.start, dtype=np.float64), variable.extents(sizes)).ravel()


def _common(root: ET.Element) -> None:
    definitions = ET.SubElement(root, "UnitDefinitions")
    for name, base in UNITS.items():
        ET.SubElement(ET.SubElement(definitions, "Unit", name=name), "BaseUnit", base)
    categories = ET.SubElement(root, "LogCategories")
    ET.SubElement(categories, "Category", name="logStatusError", description="Reason of a failed call")
    ET.SubElement(root, "DefaultExperiment", startTime="0.0", stopTime="1.0", stepSize=repr(STEP_S))


def _root(version: str, about: str, **token: str) -> ET.Element:
    facts = {"fmiVersion": version, "modelName": MODEL, **token, "description": about}
    return ET.Element(
        "fmiModelDescription", facts, generationTool="Palpate", license="Apache-2.0", variableNamingConvention="structured"
    )


def _text(root: ET.Element) -> bytes:
    ET.indent(root)
    return bytes(ET.tostring(root, encoding="utf-8", xml_declaration=True)) + b"\n"


def description_3(token: str, about: str, starts: Mapping[str, Array], sizes: Sizes) -> bytes:
    """modelDescription.xml of FMI 3.0, where a variable is an array."""
    root = _root("3.0", about, instantiationToken=token)
    can = {"modelIdentifier": MODEL, "canGetAndSetFMUState": "true", "canSerializeFMUState": "true"}
    ET.SubElement(root, "ModelExchange", can, providesDirectionalDerivatives="true")
    ET.SubElement(
        root, "CoSimulation", can, canHandleVariableCommunicationStepSize="true", recommendedIntermediateInputSmoothness="0"
    )
    _common(root)
    table = variables(3, sizes)
    references = {v.name: v.vr for v in table}
    parent = ET.SubElement(root, "ModelVariables")
    for variable in table:
        attributes = {"name": variable.name, "valueReference": str(variable.vr), "description": variable.doc}
        attributes |= _causality(variable) | _type_attributes(variable)
        start = _start(variable, starts, sizes)
        if start is not None:
            attributes["start"] = " ".join(_number(value, variable.integer) for value in start)
        if variable.rate_of:
            attributes["derivative"] = str(references[variable.rate_of])
        element = ET.SubElement(parent, "Int32" if variable.integer else "Float64", attributes)
        for extent in variable.extents(sizes):
            ET.SubElement(element, "Dimension", start=str(extent))
    structure_3(root, sizes)
    return _text(root)


def description_2(token: str, about: str, starts: Mapping[str, Array], sizes: Sizes, model: PhantomModel) -> bytes:
    """modelDescription.xml of FMI 2.0, where each element of an array is a scalar."""
    root = _root("2.0", about, guid=token)
    can = {"modelIdentifier": MODEL, "canNotUseMemoryManagementFunctions": "true"}
    can |= {"canGetAndSetFMUstate": "true", "canSerializeFMUstate": "true"}
    exchange = {"completedIntegratorStepNotNeeded": "true", "providesDirectionalDerivative": "true"}
    for interface, own in (("ModelExchange", exchange), ("CoSimulation", {"canHandleVariableCommunicationStepSize": "true"})):
        files = ET.SubElement(ET.SubElement(root, interface, can | own), "SourceFiles")
        for name in ("fmi2.c", *SOURCES):
            ET.SubElement(files, "File", name=name)
    _common(root)
    parent = ET.SubElement(root, "ModelVariables")
    table = variables(2, sizes)
    indices = Indices(table, sizes)
    for variable in table:
        start = _start(variable, starts, sizes)
        causality = _causality(variable)
        for k, index in enumerate(product(*(range(1, extent + 1) for extent in variable.extents(sizes)))):
            suffix = f"[{','.join(map(str, index))}]" if index else ""
            facts = {"name": variable.name + suffix, "valueReference": str(variable.vr + k), "description": variable.doc}
            scalar = ET.SubElement(parent, "ScalarVariable", facts | causality)
            attributes = _type_attributes(variable)
            if start is not None:
                attributes["start"] = _number(start[k], variable.integer)
            if variable.rate_of:
                attributes["derivative"] = str(next(indices.at(variable.rate_of, [k])))
            ET.SubElement(scalar, "Integer" if variable.integer else "Real", attributes)
    structure_2(root, sizes, model)
    return _text(root)


def build_description() -> bytes:
    """sources/buildDescription.xml of FMI 3.0: how to compile the FMU."""
    root = ET.Element("fmiBuildDescription", fmiVersion="3.0")
    configuration = ET.SubElement(root, "BuildConfiguration", modelIdentifier=MODEL)
    files = ET.SubElement(configuration, "SourceFileSet", language="C99")
    for name in ("fmi3.c", *SOURCES):
        ET.SubElement(files, "SourceFile", name=name)
    ET.SubElement(configuration, "Library", name="m", external="true")
    return _text(root)


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
    phantom = draw_person(phantom, seed)
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


SAMPLES = 64
"""Vertices whose displacement an FMI 2.0 master sees."""
SAMPLED_HALF_M = 0.11
"""Half width of the region about the umbilicus in which they are."""


class ExportError(UserError):
    """A phantom that this FMU cannot hold."""


def start_values(phantom: Phantom, radius_m: float) -> dict[str, Array]:
    """Return the start value of every parameter for a phantom and an indenter radius [m]: a flat array each.

    Lesions are those that the skin shows: one that lies below it is felt as a weaker and wider one.
    Raises ExportError if it has more lesions or Prony branches than the FMU has room for, or a pulse.
    """
    if phantom.breathing.pulse_m:
        raise ExportError(f"phantom.breathing.pulse_m = {phantom.breathing.pulse_m:g}: an FMU has no pulse, expected 0")
    material, lesions = phantom.stiffness, [at_skin(lesion) for lesion in phantom.lesions]
    if len(lesions) > LESIONS:
        raise ExportError(f"phantom.lesions has {len(lesions)} entries, an FMU has room for {LESIONS}")
    if len(material.prony_g) > BRANCHES:
        raise ExportError(f"phantom.stiffness.prony_g has {len(material.prony_g)} entries, an FMU has room for {BRANCHES}")
    spare = LESIONS - len(lesions)
    own: dict[str, object] = {
        "indenter_radius": radius_m,
        "pasternak_length": material.length_m,
        "dashpot": material.dashpot_s,
        "friction": material.friction,
        "voluntary": any(area.kind == "voluntary" for area in phantom.guarding),
        "lesion_count": len(lesions),
        "prony_g": [*material.prony_g, *[0.0] * (BRANCHES - len(material.prony_g))],
        "prony_tau": [*material.prony_tau_s, *[1.0] * (BRANCHES - len(material.prony_tau_s))],
        "lesion_centre": [*[lesion.centre_m for lesion in lesions], *[(0.0, 0.0)] * spare],
        "lesion_radii": [*[lesion.radii_m for lesion in lesions], *[(0.03, 0.03)] * spare],
        "lesion_contrast": [*[lesion.contrast for lesion in lesions], *[1.0] * spare],
        "lesion_edge": [*[lesion.edge_m for lesion in lesions], *[0.008] * spare],
    }
    values = {v.name: np.asarray(own.get(v.name, v.start), dtype=np.float64).ravel() for v in parameters()}
    for variable in parameters():
        low, high = variable.low, variable.high
        for value in values[variable.name]:
            if (low is not None and value < low) or (high is not None and value > high):
                raise ExportError(f"{variable.name} = {value:g} is not within the FMU's bounds, {low:g} to {high:g}")
    return values


def sample_vertices(model: PhantomModel) -> NDArray[np.int32]:
    """Vertices spread evenly over the examined front, the one at the umbilicus first: farthest-point sampling, (SAMPLES,)."""
    x, y = model.vertices[:, 0], model.vertices[:, 1]
    front = ~model.fixed & (model.normals[:, 2] > 0) & (np.maximum(np.abs(x), np.abs(y)) <= SAMPLED_HALF_M)
    pool = np.flatnonzero(front if front.any() else ~model.fixed)
    points = model.vertices[pool]
    chosen = [int(np.hypot(points[:, 0], points[:, 1]).argmin())]
    away = np.full(len(pool), np.inf)
    while len(chosen) < min(SAMPLES, len(pool)):
        away = np.minimum(away, ((points - points[chosen[-1]]) ** 2).sum(axis=1))
        chosen.append(int(away.argmax()))
    return np.asarray(pool[chosen], dtype=np.int32)


def sizes_of(model: PhantomModel, starts: Mapping[str, Array]) -> Sizes:
    """The sizes of a phantom's mesh, how many of its vertices are samples, and how many branches relax by its start values."""
    relaxing = int(np.flatnonzero(starts["prony_g"]).max(initial=-1)) + 1
    return Sizes(len(model.vertices), len(model.triangles), len(sample_vertices(model)), relaxing)


def encode_phantom(model: PhantomModel, breaths: Array, starts: dict[str, Array], token: str) -> bytes:
    """Return `resources/phantom.bin`, little-endian, in the layout of src/phantom.c.

    `breaths` is the table of a `BreathingCurve`, shape (n, 5).
    """
    laplacian = model.laplacian.copy()
    laplacian.sort_indices()
    sizes = sizes_of(model, starts)
    values = np.concatenate([starts[variable.name] for variable in parameters()])
    counts = (sizes.vertices, laplacian.nnz, sizes.triangles, sizes.samples, len(values), sizes.branches, len(breaths))
    fields = (model.areas, model.background, model.stiffening, model.tension, model.breathing)
    reals = (values, model.vertices, model.normals, *fields, laplacian.data, breaths)
    integers = (laplacian.indptr, laplacian.indices, model.triangles, sample_vertices(model))
    return b"".join(
        (
            struct.pack("<8s64s7id", b"PALPHAN2", token.encode("ascii"), *counts, float(np.median(model.background))),
            *(np.ascontiguousarray(array, dtype="<f8").tobytes() for array in reals),
            *(np.ascontiguousarray(array, dtype="<i4").tobytes() for array in integers),
            model.fixed.astype(np.uint8).tobytes(),
        )
    )
