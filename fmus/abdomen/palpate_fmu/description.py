"""modelDescription.xml for FMI 2.0 and 3.0, from the table of variables."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import chain, product
from xml.etree import ElementTree as ET

import numpy as np
from numpy.typing import NDArray

from palpate_fmu.phantom_file import sample_vertices
from palpate_fmu.variables import Sizes, Variable, VariableKind, VariableRole, variables
from palpate_models.numerics.frames import Array
from palpate_models.patient.phantom import PhantomModel


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
STEP_S = 1e-3
"""The step size a master should take."""
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
        return {
            "causality": "parameter",
            "variability": "fixed" if variable.kind is VariableKind.FIXED else "tunable",
            "initial": "exact",
        }
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


def _units(root: ET.Element) -> None:
    definitions = ET.SubElement(root, "UnitDefinitions")
    for name, base in UNITS.items():
        ET.SubElement(ET.SubElement(definitions, "Unit", name=name), "BaseUnit", base)


def _common(root: ET.Element) -> None:
    _units(root)
    categories = ET.SubElement(root, "LogCategories")
    ET.SubElement(categories, "Category", name="logStatusError", description="Reason of a failed call")
    ET.SubElement(root, "DefaultExperiment", startTime="0.0", stopTime="1.0", stepSize=repr(STEP_S))


def _text(root: ET.Element) -> bytes:
    ET.indent(root)
    return bytes(ET.tostring(root, encoding="utf-8", xml_declaration=True)) + b"\n"


def description_3(token: str, about: str, starts: Mapping[str, Array], sizes: Sizes) -> bytes:
    """modelDescription.xml of FMI 3.0, where a variable is an array."""
    root = ET.Element(
        "fmiModelDescription",
        fmiVersion="3.0",
        modelName=MODEL,
        instantiationToken=token,
        description=about,
        generationTool="Palpate",
        license="Apache-2.0",
        variableNamingConvention="structured",
    )
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
    root = ET.Element(
        "fmiModelDescription",
        fmiVersion="2.0",
        modelName=MODEL,
        guid=token,
        description=about,
        generationTool="Palpate",
        license="Apache-2.0",
        variableNamingConvention="structured",
    )
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
            scalar = ET.SubElement(
                parent,
                "ScalarVariable",
                {
                    "name": variable.name + suffix,
                    "valueReference": str(variable.vr + k),
                    "description": variable.doc,
                    **causality,
                },
            )
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


def documentation(version: int, about: str, sizes: Sizes) -> bytes:
    """documentation/index.html: what the variables are."""
    html = ET.Element("html", lang="en")
    ET.SubElement(ET.SubElement(html, "head"), "title").text = MODEL
    body = ET.SubElement(html, "body")
    ET.SubElement(body, "h1").text = "The soft abdomen"
    ET.SubElement(body, "p").text = about
    ET.SubElement(body, "p").text = (
        "indenter_position is where the sphere is at the end of a step; it moves there on a straight line. contact_force is the "
        "force on the sphere, mean over the step. Displacements are along the inward normals at rest. A refused call returns an "
        "error with a message and leaves the instance as it was."
    )
    table = ET.SubElement(body, "table", border="1", cellpadding="4")
    for row in (
        ("variable", "size", "unit", "kind", "meaning"),
        *(
            (v.name, " x ".join(map(str, v.extents(sizes))), v.unit or "", _causality(v)["causality"], v.doc)
            for v in variables(version, sizes)
        ),
    ):
        line = ET.SubElement(table, "tr")
        for cell in row:
            ET.SubElement(line, "td").text = cell
    ET.indent(html)
    return b"<!DOCTYPE html>\n" + bytes(ET.tostring(html, encoding="utf-8", method="html")) + b"\n"
