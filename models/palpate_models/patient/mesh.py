"""Triangle meshes from OBJ, STL and PLY files: whole, validated, oriented, refined in the examined region."""

from __future__ import annotations

import io
import logging
import re
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from palpate_errors import UserError, restate
from palpate_inputs import bounds, over, read_bytes
from palpate_models.numerics.frames import Array, Ints32, Mask

if TYPE_CHECKING:
    import trimesh

SUFFIXES = (".obj", ".stl", ".ply")
STL_HEADER_BYTES, STL_TRIANGLE_BYTES = 84, 50


class MeshError(UserError):
    """A mesh that cannot be a phantom. The message names the file, what is wrong, where, and what to do."""


def read_mesh(path: Path) -> tuple[Array, Ints32]:
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


class MeshLimits(NamedTuple):
    """Surfaces that can be a body."""

    largest_m: float = 3.0
    smallest_m: float = 0.05
    max_vertices: int = 20_000
    region_half_m: float = 0.112
    """Half size of the region in which a coarse mesh is refined: the default examined region and a margin."""
    near_umbilicus_m: float = 0.03
    smallest_body_m: float = 0.15
    widest_m: float = 0.9
    """Width of the body across the umbilicus, and its thickness there."""
    thickest_m: float = 0.5
    min_normal_z: float = 0.7


LIMITS: Final = MeshLimits()
UNITS_M = {
    **{"micrometres": 1e-6, "millimetres": 1e-3, "centimetres": 1e-2, "decimetres": 0.1, "kilometres": 1e3},
    **{"inches": 0.0254, "feet": 0.3048, "yards": 0.9144},
}


class TriangleMesh(NamedTuple):
    """Vertices (n, 3) [m] in A and triangles (m, 3), counter-clockwise seen from outside."""

    vertices: Array
    triangles: Ints32


def load_mesh(path: Path, edge_m: float) -> TriangleMesh:
    """Return the surface in an OBJ, STL or PLY file (metres, abdomen frame), with edges up to `edge_m` [m] where examined.

    Raises MeshError if the file cannot be read whole, or its surface is empty, not in metres, not at the origin, not facing
    the camera, degenerate, non-manifold, in several pieces, not orientable or too fine.
    """
    with restate(MeshError, MeshError, f"phantom.mesh = {path}"):
        vertices, triangles = weld(*read_mesh(path))
        check(vertices, triangles)
        triangles = orient(vertices, triangles)
        check_place(vertices, triangles)
        surface = refine(vertices, triangles, edge_m)
        if len(surface.vertices) > LIMITS.max_vertices:
            raise MeshError(
                f"{len(surface.vertices)} vertices with edges up to edge_m = {edge_m}; at most {LIMITS.max_vertices} are "
                "simulated: decimate the mesh or raise phantom.edge_m"
            )
    return surface


def weld(vertices: Array, triangles: Ints32) -> tuple[Array, Ints32]:
    """Return the mesh with equal vertices joined (STL repeats them), each triangle once, and unused vertices dropped."""
    if not len(triangles):
        raise MeshError("it has no triangles")
    if not np.isfinite(vertices).all():
        bad = int(np.flatnonzero(~np.isfinite(vertices).all(axis=1))[0])
        raise MeshError(f"vertex {bad} is not finite: {vertices[bad]}")
    scale = float(np.ptp(vertices, axis=0).max()) or 1.0
    _, first, inverse = np.unique(np.round(vertices / (scale * 1e-7)), axis=0, return_index=True, return_inverse=True)
    triangles = inverse.reshape(-1)[triangles].astype(np.int32)
    triangles = triangles[np.sort(np.unique(np.sort(triangles, axis=1), axis=0, return_index=True)[1])]
    used, inverse = np.unique(triangles, return_inverse=True)
    return vertices[first][used], inverse.reshape(-1, 3).astype(np.int32)


def check(vertices: Array, triangles: Ints32) -> None:
    """Raise MeshError unless the mesh is a manifold of sound triangles, in metres."""
    import trimesh  # noqa: PLC0415 - as in read_mesh

    size = float(np.ptp(vertices, axis=0).max())
    if not LIMITS.smallest_m <= size <= LIMITS.largest_m:
        fitting = _fitting_units(vertices, triangles)
        raise MeshError(f"its size is {size:.4g}, expected {LIMITS.smallest_m} to {LIMITS.largest_m} metres; {fitting}")
    corners = vertices[triangles]
    double_areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    flat = np.flatnonzero(double_areas <= 1e-6 * longest**2)
    if len(flat):
        raise MeshError(f"{len(flat)} degenerate triangles (no area), the first at {_place(corners[flat[0]])}: remove them")
    edges = np.sort(_half_edges(triangles), axis=1)
    unique, count = np.unique(edges, axis=0, return_counts=True)
    crowded = np.flatnonzero(count > 2)
    if len(crowded):
        where = _place(vertices[unique[crowded[0]]])
        raise MeshError(f"non-manifold: {len(crowded)} edges with more than two triangles, the first at {where}")
    border = unique[count == 1]
    if (rims := len(trimesh.graph.connected_components(border))) > 1:
        where = _place(vertices[border[0]])
        raise MeshError(f"it has {rims} borders, the first at {where}: fill its holes; one border is allowed")
    if (pieces := len(trimesh.graph.connected_components(unique))) > 1:
        raise MeshError(f"it is in {pieces} separate pieces: keep the one surface that is to be palpated")
    _check_fans(vertices, triangles)


def _fitting_units(vertices: Array, triangles: Ints32) -> str:
    """Return the units in which a surface can be a body, each with its size."""
    size, (width, thickness) = float(np.ptp(vertices, axis=0).max()), _across(vertices, triangles)
    fitting = [
        f"in {unit} it is {size * factor:.2g} m (scale it by {factor:g})"
        for unit, factor in UNITS_M.items()
        if LIMITS.smallest_body_m <= size * factor <= LIMITS.largest_m
        and width * factor <= LIMITS.widest_m
        and thickness * factor <= LIMITS.thickest_m
    ]
    return ", ".join(fitting) or "no unit fits"


def _across(vertices: Array, triangles: Ints32) -> tuple[float, float]:
    """Return width and thickness of a surface in the plane y = 0, the transverse one through the umbilicus; 0 if next to it."""
    ends = vertices[_half_edges(triangles)]
    low, high = (points[(ends[:, 0, 1] <= 0) & (ends[:, 1, 1] > 0)] for points in (ends[:, 0], ends[:, 1]))
    if not len(low):
        return 0.0, 0.0
    cut = low + (high - low) * (low[:, 1] / (low[:, 1] - high[:, 1]))[:, None]
    width, _, thickness = np.ptp(cut, axis=0).tolist()
    return width, thickness


def check_place(vertices: Array, triangles: Ints32) -> None:
    """Raise MeshError unless the surface passes through the origin of A, the umbilicus, as a body does, and faces +z there."""
    import trimesh  # noqa: PLC0415 - as in read_mesh

    frame = "abdomen frame: x to the patient's left, y to the head, z outward"
    nearest = trimesh.triangles.closest_point(vertices[triangles], np.zeros((len(triangles), 3)))
    away = np.linalg.norm(nearest, axis=1)
    if away.min() > LIMITS.near_umbilicus_m:
        place = _place(nearest[[away.argmin()]])
        raise MeshError(f"the umbilicus must be at the origin ({frame}), but the surface is nearest to it at {place}")
    width, thickness = _across(vertices, triangles)
    if width > LIMITS.widest_m or thickness > LIMITS.thickest_m:
        raise MeshError(
            f"at the umbilicus it is {width:.3g} m wide and {thickness:.3g} m thick, expected up to {LIMITS.widest_m} and "
            f"{LIMITS.thickest_m} metres; {_fitting_units(vertices, triangles)}"
        )
    cross = _cross(vertices, triangles)[away <= away.min() + 1e-6].sum(axis=0)
    normal = cross / max(np.linalg.norm(cross), 1e-300)
    border = boundary_vertices(len(vertices), triangles)
    if normal[2] < LIMITS.min_normal_z:
        raise MeshError(f"at the umbilicus the surface faces ({', '.join(f'{x:.2g}' for x in normal)}), expected +z ({frame})")
    if border.any() and vertices[border, 2].mean() > LIMITS.near_umbilicus_m:
        rise = vertices[border, 2].mean()
        raise MeshError(f"its border lies {rise:.2g} m above the umbilicus, expected below: it seems to lie face down ({frame})")


def orient(vertices: Array, triangles: Ints32) -> Ints32:
    """The triangles, counter-clockwise seen from outside: of positive volume when closed, else facing +z about the umbilicus.

    Raises MeshError if the surface is not orientable.
    """
    m = len(triangles)
    half = _half_edges(triangles)
    face = np.tile(np.arange(m), 3)
    order = np.lexsort((half.max(axis=1), half.min(axis=1)))
    low, high = half.min(axis=1)[order], half.max(axis=1)[order]
    twin = np.flatnonzero((low[1:] == low[:-1]) & (high[1:] == high[:-1]))
    f, g = order[twin], order[twin + 1]
    flip = half[f, 0] == half[g, 0]  # neighbours that run along their edge the same way disagree
    rows = np.concatenate((face[f], face[f] + m))
    columns = np.concatenate((face[g] + m * flip, face[g] + m * ~flip))
    graph = sparse.coo_array((np.ones(len(rows)), (rows, columns)), shape=(2 * m, 2 * m))
    _, side = connected_components(graph, directed=False)
    if (side[:m] == side[m:]).any():
        raise MeshError("it is not orientable (a Moebius strip): it has no outside")
    turned = side[:m] != side[0]
    out = np.where(turned[:, None], triangles[:, ::-1], triangles)
    cross = _cross(vertices, out)
    closed = len(twin) * 2 == len(half)
    middle = vertices[out].mean(axis=1)
    away = np.linalg.norm(middle, axis=1)
    near = away <= away.min() + LIMITS.near_umbilicus_m
    outward = float((cross * middle).sum()) if closed else float(cross[near, 2].sum())
    return np.ascontiguousarray(out if outward > 0 else out[:, ::-1], dtype=np.int32)


def refine(vertices: Array, triangles: Ints32, edge_m: float) -> TriangleMesh:
    """Return the mesh with edges of at most `edge_m` [m] on the front of the examined region, without hanging vertices."""
    for _ in range(16):
        pairs, inverse = np.unique(np.sort(_half_edges(triangles), axis=1), axis=0, return_inverse=True)
        of_face = inverse.reshape(3, -1).T  # edges (0 1), (1 2), (2 0) of each triangle
        length = np.linalg.norm(vertices[pairs[:, 0]] - vertices[pairs[:, 1]], axis=1)
        corners = vertices[triangles]
        near = (corners[:, :, :2].min(axis=1) < LIMITS.region_half_m).all(axis=1)
        near &= (corners[:, :, :2].max(axis=1) > -LIMITS.region_half_m).all(axis=1)
        near &= _cross(vertices, triangles)[:, 2] > 0
        wanted = np.zeros(len(pairs), dtype=np.bool_)
        wanted[of_face[near]] = True
        split = wanted & (length > edge_m)
        if not split.any() or len(vertices) > LIMITS.max_vertices:
            break
        # Split only the longest edges of a neighbourhood at a time: bisection of longest edges keeps angles sound.
        longest_of_face = length[of_face].max(axis=1)
        longest = of_face[np.arange(len(of_face)), length[of_face].argmax(axis=1)]
        keep = np.zeros(len(pairs), dtype=np.bool_)
        for k in range(3):
            is_longest = length[of_face[:, k]] >= 0.7 * longest_of_face
            keep[of_face[is_longest, k]] = True
        split &= keep
        while True:  # a split edge implies the longest one of its triangles, so that no sliver arises (Rivara 1984)
            more = split.copy()
            more[longest[split[of_face].any(axis=1)]] = True
            if (more == split).all():
                break
            split = more
        middle = np.full(len(pairs), -1, dtype=np.int32)
        middle[split] = len(vertices) + np.arange(int(split.sum()))
        vertices = np.concatenate((vertices, vertices[pairs[split]].mean(axis=1)))
        triangles = _split_triangles(triangles, middle[of_face], length[of_face])
    return TriangleMesh(vertices, triangles)


def _split_triangles(triangles: Ints32, middle: Ints32, length: Array) -> Ints32:
    """Return triangles cut at the given edge midpoints, shape (m, 3), -1 where an edge is whole; the longer edge first."""
    out = [triangles[(middle < 0).all(axis=1)]]
    for k in range(3):
        turned, m, size = (np.roll(array, -k, axis=1) for array in (triangles, middle, length))
        a, b, c = turned.T
        ab, bc, ca = m.T
        one = (ab >= 0) & (bc < 0) & (ca < 0)
        out += [np.column_stack((a, ab, c))[one], np.column_stack((ab, b, c))[one]]
        two = (ab >= 0) & (bc >= 0) & (ca < 0)
        first = two & (size[:, 0] > size[:, 1])
        out += [np.column_stack(t)[first] for t in ((ab, b, bc), (ab, bc, c), (a, ab, c))]
        second = two & ~first
        out += [np.column_stack(t)[second] for t in ((ab, b, bc), (a, ab, bc), (a, bc, c))]
    a, b, c = triangles.T
    ab, bc, ca = middle.T
    three = (middle >= 0).all(axis=1)
    out += [np.column_stack(t)[three] for t in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))]
    return np.concatenate(out).astype(np.int32)


def boundary_vertices(n: int, triangles: Ints32) -> Mask:
    """Return True for each of `n` vertices on an open border, shape (n,)."""
    unique, count = np.unique(np.sort(_half_edges(triangles), axis=1), axis=0, return_counts=True)
    border = np.zeros(n, dtype=np.bool_)
    border[unique[count == 1].ravel()] = True
    return border


def vertex_normals(vertices: Array, triangles: Ints32) -> Array:
    """Outward unit vertex normals, shape (n, 3): the mean of the triangles' normals weighted by area."""
    cross = _cross(vertices, triangles)
    normals = np.zeros_like(vertices)
    for k in range(3):
        np.add.at(normals, triangles[:, k], cross)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.asarray(np.where(length > 0, normals / np.maximum(length, 1e-300), (0.0, 0.0, 1.0)))


def _check_fans(vertices: Array, triangles: Ints32) -> None:
    """Raise MeshError where surfaces touch in a single vertex: a vertex's triangles must form one fan."""
    import trimesh  # noqa: PLC0415 - as in read_mesh

    pairs, edge = trimesh.graph.face_adjacency(triangles, return_edges=True)
    # Corner k of face f is node 3 f + k; corners at the same vertex are joined across the edge.
    joined = [[3 * f + np.argmax(triangles[f] == end[:, None], axis=1) for end in edge.T] for f in pairs.T]
    nodes = (np.concatenate(joined[0]), np.concatenate(joined[1]))
    graph = sparse.coo_array((np.ones(len(nodes[0])), nodes), shape=(triangles.size,) * 2)
    _, fan = connected_components(graph, directed=False)
    fans = np.unique(np.column_stack((triangles.ravel(), fan)), axis=0)
    touched, count = np.unique(fans[:, 0], return_counts=True)
    if (count > 1).any():
        where = _place(vertices[touched[count > 1][:1]])
        raise MeshError(f"non-manifold: surfaces touch in {int((count > 1).sum())} single vertices, the first at {where}")


def _half_edges(triangles: Ints32) -> Ints32:
    """Directed edges, shape (3 m, 2): all first edges, then all second, then all third."""
    return np.concatenate((triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]))


def _cross(vertices: Array, triangles: Ints32) -> Array:
    """Twice the area vectors of triangles, shape (m, 3)."""
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    return np.asarray(np.cross(b - a, c - a))


def _place(points: Array) -> str:
    return "(" + ", ".join(f"{value:.4g}" for value in points.mean(axis=0)) + ") m"
