"""Reads the model description of any FMU: its variables, with arrays also where FMI 2.0 has scalars, and what a validator finds.

A finding does not make an FMU unusable: many tools write descriptions that break a rule and still describe every variable well.
"""

import re
import tempfile
import zipfile
from collections.abc import Collection, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from math import prod
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree as ET

from palpate_errors import UserError, restate
from palpate_inputs import MB, InputFile, bounds, brief, check_archive, check_xml, over

DESCRIPTION = "modelDescription.xml"
_VERSION = re.compile(r"2\.0|3\.\d+")
_ELEMENT = re.compile(r"^(.*?)((?:\[ *-?\d+(?: *, *-?\d+)* *\])+)$")
_INDEX = re.compile(r"-?\d+")
NAME_CHARACTERS = 2000
_NAMED = 30
"""Variables that a message lists."""


class FmuError(UserError):
    """An FMU that cannot be loaded, or one of its functions that failed: holds the FMU's messages."""


class FmuVariable(NamedTuple):
    """A variable: a scalar, or an array in any FMI version."""

    name: str
    references: tuple[int, ...]
    """One value reference, or one per element if the FMU has the elements as scalars."""
    shape: tuple[int, ...]
    causality: str
    variability: str
    type: str
    unit: str | None
    low: str | None
    high: str | None
    doc: str | None

    @property
    def size(self) -> int:
        """Number of values."""
        return prod(self.shape)


def read_description(path: Path) -> tuple[Any, tuple[str, ...]]:
    """Return FMPy's model description and the validator's findings. Raises FmuError if it is not an FMU, or of FMI 1.0."""
    import fmpy  # noqa: PLC0415  (slow to import)

    with open_fmu(path) as archive:
        try:
            root = ET.fromstring(_read_xml(archive))
        except FmuError as error:
            raise FmuError(f"{path}: {error}") from error
        except Exception as error:  # a damaged archive raises many kinds
            raise FmuError(f"{path}: not an FMU: {error}") from error
    if root.tag != "fmiModelDescription":
        raise FmuError(f"{path}: not an FMU: the root of its {DESCRIPTION} is {root.tag}")
    version = root.get("fmiVersion", "")
    if not _VERSION.fullmatch(version):
        raise FmuError(f"{path}: FMI {version or 'of no version'}; expected 2.0 or 3.0")
    for element in root:
        name = element.get("modelIdentifier")
        if name is not None and not (name.isascii() and name.isidentifier()):  # FMI: it names the library and its functions
            raise FmuError(f"{path}: modelIdentifier = {brief(name)}: expected an identifier of C")
    starts = {variable.get("valueReference"): variable.get("start") for variable in root.iterfind("ModelVariables/*")}
    for variable in root.iterfind("ModelVariables/*[Dimension]"):
        for dimension in variable.iterfind("Dimension"):
            if dimension.get("start", starts.get(dimension.get("valueReference"))) is None:
                raise FmuError(f"{path}: variable {brief(variable.get('name', ''))}: a dimension has no size")
    try:
        return fmpy.read_model_description(str(path)), ()
    except Exception as error:
        findings = tuple(getattr(error, "problems", (str(error),)))
    try:
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / DESCRIPTION
            _simplify(root)
            ET.ElementTree(root).write(file)
            return fmpy.read_model_description(str(file), validate=False), findings
    except Exception as error:
        raise FmuError(f"{path}: its {DESCRIPTION} cannot be read: {error}; {'; '.join(findings)}") from error


@contextmanager
def open_fmu(path: Path) -> Iterator[zipfile.ZipFile]:
    """Open an FMU whose files are within the bounds and may be unpacked. Raises FmuError."""
    if not path.is_file():
        raise FmuError(f"{path}: no such file")
    with ExitStack() as stack:
        with restate(Exception, FmuError, f"{path}: not an FMU", but=FmuError):  # a damaged archive raises many kinds
            file = stack.enter_context(InputFile(path, FmuError, bounds().document_mb * MB))
            archive = check_archive(stack.enter_context(zipfile.ZipFile(file)), path, FmuError)
            if DESCRIPTION not in archive.namelist():
                raise FmuError(f"{path}: not an FMU: it has no {DESCRIPTION}")
        yield archive


def _read_xml(archive: zipfile.ZipFile) -> bytes:
    """Return the model description. Raises FmuError if it is too large."""
    if archive.getinfo(DESCRIPTION).file_size > bounds().document_mb * MB:
        raise over(DESCRIPTION, f"{archive.getinfo(DESCRIPTION).file_size / MB:.0f} MB", "document_mb", FmuError)
    return check_xml(archive.read(DESCRIPTION), f"its {DESCRIPTION}", FmuError)


def _simplify(root: ET.Element) -> None:
    """Remove references that lead nowhere and that no simulation needs; FMPy reads none of them leniently."""
    variables = root.find("ModelVariables")
    variables = ET.SubElement(root, "ModelVariables") if variables is None else variables
    older = root.get("fmiVersion") == "2.0"
    known = set(map(str, range(1, len(variables) + 1))) if older else {element.get("valueReference") for element in variables}
    for parent in [root.find("ModelStructure"), *root.iterfind("ModelStructure/*")]:
        for unknown in list(parent if parent is not None else ()):
            unknown.attrib.pop("dependencies", None)
            unknown.attrib.pop("dependenciesKind", None)
            reference = unknown.get("index" if older else "valueReference")
            if parent is not None and reference not in known and not len(unknown):
                parent.remove(unknown)
    types = {element.get("name") for element in root.iterfind("TypeDefinitions/*")}
    for variable in variables:
        variable.attrib.setdefault("initial", "")  # else FMPy derives it, for legal combinations of the other attributes only
        for element in (variable, *variable):
            element.attrib.pop("derivative", None)
            element.attrib.pop("clocks", None)
            if element.get("declaredType") not in types:
                element.attrib.pop("declaredType", None)


def binary_folders(path: Path) -> tuple[str, ...]:
    """Return the platforms for which an FMU has binaries, as its folders name them."""
    with open_fmu(path) as archive:
        parts = [name.split("/") for name in archive.namelist()]
    return tuple(sorted({part[1] for part in parts if part[0] == "binaries" and len(part) > 2 and part[-1]}))


def read_variables(description: Any) -> dict[str, FmuVariable]:
    """Return the variables of an FMPy model description, by name.

    Scalars that are named like the elements of an array (`x[0]`, `x[1]`; `x[1,1]`; `x[0][0]`) are one array, from whatever index
    they begin at, if none is missing.
    """
    single = read_scalars(description)
    elements: dict[str, dict[tuple[int, ...], FmuVariable]] = {}
    for variable in single.values():
        if not variable.shape and (element := _ELEMENT.match(variable.name)):
            elements.setdefault(element[1], {})[tuple(map(int, _INDEX.findall(element[2])))] = variable
    for name, members in elements.items():
        shape = _shape(members)
        first = members[min(members)]
        if shape is None or name in single or any(m.type != first.type for m in members.values()):
            continue
        references = tuple(members[index].references[0] for index in sorted(members))
        single[name] = first._replace(name=name, references=references, shape=shape)
        for member in members.values():
            del single[member.name]
    return single


def _shape(indices: Collection[tuple[int, ...]]) -> tuple[int, ...] | None:
    """Return the shape of the array with these indices; None if it has gaps."""
    axes = [set(axis) for axis in zip(*indices, strict=False)]
    shape = tuple(max(axis) - min(axis) + 1 for axis in axes)
    same = len({len(index) for index in indices}) == 1
    return shape if same and prod(shape) == len(indices) else None


def read_scalars(description: Any) -> dict[str, FmuVariable]:
    """Return the variables as the FMU has them: an array of FMI 2.0 is one scalar per element. Raises FmuError."""
    by_reference = {v.valueReference: v for v in description.modelVariables}
    found = {}
    for v in description.modelVariables:
        name = f"variable {brief(v.name)}"
        with restate((KeyError, TypeError, ValueError), FmuError, f"{name}: the size of a dimension is not a number"):
            extents = [int(by_reference[d.valueReference].start if d.start is None else d.start) for d in v.dimensions or ()]
        if not 0 <= prod(extents) <= bounds().elements or min(extents, default=0) < 0:
            raise over(name, f"dimensions {brief(extents)}", "elements", FmuError)
        if len(v.name) > NAME_CHARACTERS:
            raise FmuError(f"{name}: a name of {len(v.name)} characters; allowed are {NAME_CHARACTERS}")
        unit = v.unit or (v.declaredType.unit if v.declaredType else None)
        rest = (v.causality, v.variability, v.type, unit, v.min, v.max, v.description)
        found[v.name] = FmuVariable(v.name, (v.valueReference,), tuple(extents), *rest)
    return found


def list_names(variables: Mapping[str, Any]) -> str:
    """Return the names of variables as text, of at most `_NAMED`."""
    names = list(variables)
    rest = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
    return ", ".join(names[:_NAMED]) + rest
