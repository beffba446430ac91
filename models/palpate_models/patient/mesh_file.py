"""Triangles from OBJ, STL and PLY files: whole, with indices that exist."""

from __future__ import annotations

import io
import logging
import re
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from palpate_errors import UserError, restate
from palpate_inputs import bounds, over, read_bytes
from palpate_models.numerics.frames import Array

if TYPE_CHECKING:
    import trimesh

IntArray = NDArray[np.int32]

SUFFIXES = (".obj", ".stl", ".ply")
STL_HEADER_BYTES, STL_TRIANGLE_BYTES = 84, 50


class MeshError(UserError):
    """A mesh that cannot be a phantom. The message names the file, what is wrong, where, and what to do."""


def read_mesh(path: Path) -> tuple[Array, IntArray]:
    """Return the vertices, shape (n, 3), and triangles, shape (m, 3), of a file as they are written.

    Colours, textures and materials are not read.

    Raises MeshError if the file is missing, of another format, has fewer elements than it promises, or a face names a vertex
    that is not there.
    """
    import trimesh  # noqa: PLC0415 - only user meshes need it, and it takes 0.3 s to import

    logging.getLogger("trimesh").setLevel(logging.CRITICAL + 1)  # it logs tracebacks of files that are refused here
    if path.suffix.lower() not in SUFFIXES:
        raise MeshError(f"expected a file in {', '.join(SUFFIXES)}")
    if not path.is_file():
        raise MeshError("no such file")
    content = read_bytes(path, MeshError)
    with restate(Exception, MeshError, f"cannot be read as {path.suffix.lower()}, it is damaged or not whole", but=MeshError):
        if path.suffix.lower() == ".stl":
            # One of text; a binary one has zeros, and its header may begin with `solid` too.
            as_text = content[:5].lower() == b"solid" and b"facet" in content[:1000].lower() and b"\0" not in content[:1000]
            content = _utf8(content.lower()) if as_text else content
            _check_stl(content, as_text)
        elif path.suffix.lower() == ".obj":
            content = _utf8(content.replace(b"\\\r\n", b" ").replace(b"\\\n", b" "))  # lines may be continued
            _check_obj(content.decode())
        else:
            header, end, body = content.partition(b"end_header")
            content = _utf8(header) + end + body
            _check_ply_header(header if end else b"", body)
        loaded = trimesh.load_mesh(io.BytesIO(content), file_type=path.suffix.lower()[1:], process=False, skip_materials=True)
        _check_ply(loaded)
        vertices = np.array(loaded.vertices, dtype=np.float64).reshape(-1, 3)
        triangles = np.array(loaded.faces, dtype=np.int32).reshape(-1, 3)
    _check_counts(len(vertices), len(triangles))
    wrong = np.argwhere((triangles < 0) | (triangles >= len(vertices)))
    if len(wrong):
        face, corner = wrong[0]
        raise MeshError(f"face {face} names vertex {triangles[face, corner]}, the vertices are 0 to {len(vertices) - 1}")
    return vertices, triangles


def _check_counts(*counts: int) -> None:
    if max(counts, default=0) > bounds().elements:
        raise over("the mesh", f"{max(counts)} vertices or faces", "elements", MeshError)


def _utf8(text: bytes) -> bytes:
    """Return a text whose comments and names are of another encoding as UTF-8."""
    return text.decode(errors="replace").encode()


def _check_ply_header(header: bytes, body: bytes) -> None:
    """Raise MeshError if the header of a PLY file is not whole, or promises fewer rows than the text after it has."""
    counts = [int(count) for count in re.findall(rb"^element\s+\w+\s+(\d{1,18})\s*$", header, re.MULTILINE)]
    if not (header.startswith(b"ply") and len(counts) == len(re.findall(rb"^element\b", header, re.MULTILINE))):
        raise MeshError("its header, from `ply` to `end_header`, is not whole")
    _check_counts(*counts)
    if missing := [axis for axis in "xyz" if not re.search(rb"^property\s+\w+\s+%b\s*$" % axis.encode(), header, re.M)]:
        raise MeshError(f"its vertices have no property {', '.join(missing)}")
    if not re.search(rb"^property\s+list\s+\w+\s+\w+\s+vertex_ind(ex|ices)\s*$", header, re.MULTILINE):
        raise MeshError("its faces have no list vertex_indices: triangles are read, not strips or points")
    if re.search(rb"^format\s+ascii", header, re.MULTILINE) and (rows := len(re.findall(rb"\S.*", body))) > sum(counts):
        raise MeshError(f"its header promises {sum(counts)} rows, {rows} are there")


def _check_ply(loaded: trimesh.Trimesh) -> None:
    """Raise MeshError if an element of a PLY file has fewer rows than its header says."""
    for name, element in loaded.metadata.get("_ply_raw", {}).items():
        data, promised = element.get("data", ()), element["length"]
        columns = list(data.values()) if isinstance(data, dict) else [data]
        rows = min((len(column) for column in columns), default=0)
        if name in ("vertex", "face") and rows < promised:
            raise MeshError(f"its header promises {promised} of {name}, {rows} are there: the file is not whole")
        short = [row for row in columns[0] if name == "face" and isinstance(row, list | np.ndarray) and len(row) < 3]
        if short:
            raise MeshError(f"a face names {len(short[0])} vertices, expected at least 3: the file is not whole")


def _check_stl(content: bytes, as_text: bool) -> None:
    """Raise MeshError if an STL file ends early."""
    if as_text:
        begun, ended = len(re.findall(rb"^[ \t]*facet\s", content, re.MULTILINE)), content.count(b"endfacet")
        if begun != ended or b"endsolid" not in content[-1000:]:
            raise MeshError(f"{begun} triangles begin and {ended} end, and it has no endsolid: the file is not whole")
        return
    promised = int.from_bytes(content[80:STL_HEADER_BYTES], "little")
    room = max(len(content) - STL_HEADER_BYTES, 0)
    if room != promised * STL_TRIANGLE_BYTES:
        there = room / STL_TRIANGLE_BYTES
        raise MeshError(f"its header promises {promised} triangles, {there:g} are there: the file is not whole, or no STL")
    _check_counts(promised)


def _check_obj(content: str) -> None:
    """Raise MeshError if a face of an OBJ file names vertices that are not there: they count from 1, or from -1 backwards."""
    if "\0" in content:
        raise MeshError("it is not a text in UTF-8")
    vertices = len(re.findall(r"^[ \t]*v\s", content, re.MULTILINE))
    faces = re.findall(r"^[ \t]*f[ \t](.*)$", content, re.MULTILINE)
    _check_counts(vertices, len(faces))
    for number, face in enumerate(faces):
        corners = [int(corner.split("/")[0]) for corner in face.split("#")[0].split()]
        if len(corners) < 3:
            raise MeshError(f"face {number} names {len(corners)} vertices, expected at least 3: the file is not whole")
        for corner in corners:
            if corner == 0 or abs(corner) > vertices:
                raise MeshError(f"face {number} names vertex {corner}, the vertices are 1 to {vertices}")
