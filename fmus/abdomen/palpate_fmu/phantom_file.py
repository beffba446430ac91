"""The phantom as the FMU reads it: `resources/phantom.bin`, little-endian, in the layout of src/phantom.c."""

import struct
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from palpate_errors import UserError
from palpate_fmu.variables import BRANCHES, LESIONS, Sizes, parameters
from palpate_models.numerics.frames import Array
from palpate_models.patient.field import at_skin
from palpate_models.patient.phantom import PhantomModel
from palpate_models.patient.schema import Phantom

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
    """Return the phantom file; `breaths` is the table of a `BreathingCurve`, shape (n, 5)."""
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
