"""ModelStructure of the model description: outputs, derivatives of the continuous states, and their dependencies.

Without dependencies FMI assumes every input, state and time, which holds for contact outputs. For FMI 2.0, in which each element
of an array is a scalar, the sparsity of the states' derivatives is written, since integrators use it.
"""

from collections.abc import Iterable, Iterator, Sequence
from itertools import chain
from xml.etree import ElementTree as ET

import numpy as np
from numpy.typing import NDArray

from palpate_fmu.phantom_file import sample_vertices
from palpate_fmu.variables import Sizes, Variable, VariableRole, variables
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
    """ModelStructure of FMI 2.0, by places of scalars in ModelVariables."""
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
