"""Meshes of users: what is taken, what is refused, and in which words."""

import numpy as np
import pytest
import trimesh

from palpate_models.numerics.frames import look_at
from palpate_models.patient.abdomen import parametric_surface
from palpate_models.patient.mesh import MeshError, orient, refine
from palpate_models.patient.phantom import build_phantom
from palpate_models.patient.schema import Phantom


def dome(subdivisions=4):
    """A closed ellipsoid whose top is at the origin."""
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions, radius=1.0)
    return mesh.vertices * (0.18, 0.23, 0.10) - (0, 0, 0.10), np.array(mesh.faces)


def front(vertices, faces):
    """The faces of a dome that has no back."""
    return faces[vertices[faces][:, :, 2].min(axis=1) > -0.08]


def write(path, vertices, faces):
    trimesh.Trimesh(vertices, faces, process=False).export(path)
    return Phantom(kind="mesh", mesh=str(path))


@pytest.mark.parametrize("suffix", ["obj", "stl", "ply"])
def test_every_format_gives_the_same_phantom(tmp_path, suffix):
    vertices, faces = dome()
    model = build_phantom(write(tmp_path / f"belly.{suffix}", vertices, faces), 0)
    top = np.argmin(np.linalg.norm(model.vertices, axis=1))
    assert np.linalg.norm(model.vertices[top]) < 0.004
    assert model.normals[top, 2] > 0.99
    examined = (np.abs(model.vertices[:, :2]) <= 0.10).all(axis=1) & (model.normals[:, 2] > 0.2)
    pairs = np.concatenate((model.triangles[:, :2], model.triangles[:, 1:]))
    pairs = pairs[examined[pairs].all(axis=1)]
    assert np.linalg.norm(model.vertices[pairs[:, 0]] - model.vertices[pairs[:, 1]], axis=1).max() <= 0.005
    assert model.fixed[model.vertices[:, 2] < -0.195].all()


def test_a_triangle_that_is_there_twice_counts_once(tmp_path):
    vertices, faces = dome(3)
    once, twice = (build_phantom(write(tmp_path / "belly.ply", vertices, f), 0) for f in (faces, [*faces, *faces[:9, ::-1]]))
    assert len(once.vertices) == len(twice.vertices)


def test_refinement_leaves_no_hanging_vertices():
    vertices, faces = dome(3)
    surface = refine(vertices, faces.astype(np.int32), 0.005)
    mesh = trimesh.Trimesh(surface.vertices, surface.triangles, process=False)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.area == pytest.approx(trimesh.Trimesh(vertices, faces, process=False).area)


def test_open_surface_has_its_border_fixed(tmp_path):
    vertices, faces = dome()
    model = build_phantom(write(tmp_path / "open.ply", vertices, front(vertices, faces)), 0)
    assert model.fixed.any()
    assert (~model.fixed).any()
    assert model.normals[np.argmin(np.linalg.norm(model.vertices, axis=1)), 2] > 0.99


@pytest.mark.parametrize("mess", ["inside_out", "every_other"])
def test_orientation_is_put_right(mess):
    vertices, faces = dome(2)
    turned = faces[:, ::-1].copy() if mess == "inside_out" else faces.copy()
    if mess == "every_other":
        turned[::2] = turned[::2, ::-1]
    out = orient(vertices, turned.astype(np.int32))
    assert trimesh.Trimesh(vertices, out, process=False).volume == pytest.approx(
        trimesh.Trimesh(vertices, faces, process=False).volume
    )


def test_a_parametric_abdomen_survives_the_way_through_a_file(tmp_path):
    shape = parametric_surface((0.36, 0.46, 0.20), 0.005)
    model = build_phantom(write(tmp_path / "abdomen.ply", shape.vertices, shape.triangles), 0)
    assert len(model.vertices) < 2 * len(shape.vertices)


def refused(path, message):
    with pytest.raises(MeshError, match=message) as error:
        build_phantom(Phantom(kind="mesh", mesh=str(path)), 0)
    assert str(path) in str(error.value)
    assert "phantom.mesh" in str(error.value)


def ply(vertices, faces, *, promised=0, comment=""):
    """An ASCII PLY whose header promises `promised` more faces than there are."""
    header = (
        f"ply\nformat ascii 1.0\n{comment}element vertex {len(vertices)}\nproperty float x\nproperty float y\nproperty float z\n"
    )
    header += f"element face {len(faces) + promised}\nproperty list uchar int vertex_indices\nend_header\n"
    rows = [*(" ".join(map(repr, map(float, v))) for v in vertices), *(" ".join(map(str, (len(f), *f))) for f in faces)]
    return (header + "\n".join(rows) + "\n").encode()


BOX = trimesh.creation.box((0.4, 0.5, 0.2)).apply_translation((0, 0, -0.1))
QUADS = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
CORNERS = [(x, y, z) for x in (-0.2, 0.2) for y in (-0.25, 0.25) for z in (-0.2, 0)]


@pytest.mark.parametrize("kind", ["ply", "ply_ascii", "ply_quads", "stl", "stl_ascii"])
def test_a_file_that_was_cut_off_is_refused(tmp_path, kind):
    ours = {"ply_quads": ply(CORNERS, QUADS), "ply_ascii": ply(*dome(3))}
    content = ours.get(kind) or trimesh.Trimesh(*dome(3), process=False).export(file_type=kind)
    content = content.encode() if isinstance(content, str) else content
    path = tmp_path / f"cut.{kind[:3]}"
    path.write_bytes(content)
    build_phantom(Phantom(kind="mesh", mesh=str(path)), 0)
    for share in (0.3, 0.6, 0.9, 0.99):
        path.write_bytes(content[: int(share * len(content))])
        refused(path, "not whole")


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("beyond.ply", ply(BOX.vertices, [*BOX.faces, (0, 1, 12)]), "face 12 names vertex 12, the vertices are 0 to 7"),
        ("negative.ply", ply(BOX.vertices, [*BOX.faces, (0, 1, -3)]), "face 12 names vertex -3"),
        ("promised.ply", ply(BOX.vertices, BOX.faces, promised=5), "promises 17 of face, 12 are there"),
        ("beyond.obj", BOX.export(file_type="obj") + "\nf 1 2 99\n", "face 12 names vertex 99, the vertices are 1 to 8"),
        ("zero.obj", BOX.export(file_type="obj") + "\nf 0 1 2\n", "face 12 names vertex 0, the vertices are 1 to 8"),
        ("backwards.obj", BOX.export(file_type="obj") + "\nf -1 -2 -9\n", "face 12 names vertex -9"),
        ("short.obj", BOX.export(file_type="obj") + "\nf 1 2", "names 2 vertices"),
        ("wide.obj", BOX.export(file_type="obj").encode("utf-16"), "not a text in UTF-8"),
        ("fewer.ply", ply(BOX.vertices, BOX.faces, promised=-5), "its header promises 15 rows, 20 are there"),
        ("count.ply", ply(BOX.vertices, BOX.faces).replace(b"vertex 8", b"vertex -8"), "is not whole"),
        ("stl.ply", BOX.export(file_type="stl"), "is not whole"),
        ("ply.stl", ply(BOX.vertices, BOX.faces), "not whole, or no STL"),
        ("x.step", "x", r"expected a file in \.obj"),
        ("junk.ply", b"\x00\x01 no mesh at all", "is not whole"),
        ("empty.obj", "# nothing\n", "no triangles|cannot be read"),
        ("points.obj", "v 0 0 0\nv 0.1 0 0\nv 0 0.1 0\n", "no triangles|cannot be read"),
        ("strips.ply", ply(BOX.vertices, BOX.faces).replace(b"vertex_indices", b"tristrips"), "no list vertex_indices"),
        ("flat.ply", ply(BOX.vertices, BOX.faces).replace(b"property float z\n", b""), "no property z"),
        ("nothing.obj", None, "no such file"),
    ],
)
def test_a_file_that_is_not_what_its_header_says_is_refused(tmp_path, name, content, words):
    if content is not None:
        (tmp_path / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    refused(tmp_path / name, words)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("comment.obj", "# größe\n".encode("latin-1") + BOX.export(file_type="obj").encode()),
        ("lines.obj", BOX.export(file_type="obj").encode().replace(b"f ", b"f \\\n ")),
        ("comment.ply", ply(BOX.vertices, BOX.faces, comment="comment größe\n").decode().encode("latin-1")),
        ("name.stl", BOX.export(file_type="stl_ascii").encode().replace(b"solid", "solid größe".encode("latin-1"), 1)),
        ("upper.stl", BOX.export(file_type="stl_ascii").upper().encode()),
        ("binary.stl", b"solid facet".ljust(80) + BOX.export(file_type="stl")[80:]),
        ("texture.ply", ply(BOX.vertices, BOX.faces, comment="comment TextureFile nothing.png\n")),
        ("material.obj", b"mtllib nothing.mtl\nusemtl skin\n" + BOX.export(file_type="obj").encode()),
    ],
)
def test_other_writers_files_are_read_without_their_textures(tmp_path, capfd, name, content):
    (tmp_path / name).write_bytes(content)
    assert len(build_phantom(Phantom(kind="mesh", mesh=str(tmp_path / name)), 0).vertices) > len(BOX.vertices)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("name", "turn", "words"),
    [
        ("prone", (1, -1, -1), r"faces \(-?0, -?0, -1\), expected \+z"),
        ("open", (1, -1, -1), "it seems to lie face down"),
        ("y_up", None, r"faces \(.*1, .*\), expected \+z"),
    ],
)
def test_a_body_that_does_not_face_up_is_refused(tmp_path, name, turn, words):
    vertices, faces = dome(3)
    if name == "open":
        faces = front(vertices, faces)
    vertices = vertices[:, (0, 2, 1)] if turn is None else vertices * turn
    write(tmp_path / f"{name}.ply", vertices, faces)
    refused(tmp_path / f"{name}.ply", words)


@pytest.mark.parametrize("mesh", [BOX, trimesh.creation.cylinder(0.2, 0.2).apply_translation((0, 0, -0.1))])
def test_refining_large_triangles_leaves_no_slivers(mesh):
    corners = mesh.vertices[mesh.faces]
    surface = refine(mesh.vertices, mesh.faces.astype(np.int32), 0.005)
    assert shape(surface.vertices[surface.triangles]).min() > 0.49 * shape(corners).min()


def shape(corners):
    """Twice the area over the longest edge squared."""
    edges = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    return np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / edges**2


def with_vertex(vertices, faces, vertex):
    """The mesh and a triangle of its first edge and one more vertex."""
    return np.vstack((vertices, vertex)), np.vstack((faces, [*faces[0][:2], len(vertices)]))


def mirrored(vertices, faces):
    """The mesh and its mirror image, which touches it in the top vertex."""
    top = int(np.argmin(np.linalg.norm(vertices, axis=1)))
    index = np.arange(len(vertices)) + len(vertices)
    index[top] = top
    other = vertices * (1, 1, -1) + (0, 0, 2 * vertices[top, 2])
    return np.vstack((vertices, other)), np.vstack((faces, index[faces][:, ::-1]))


def with_two_holes(vertices, faces):
    middle = vertices[faces].mean(axis=1)
    holes = [np.argmin(np.linalg.norm(middle - at, axis=1)) for at in ((0.08, 0.08, -0.02), (-0.08, -0.08, -0.02))]
    return vertices, np.delete(faces, holes, axis=0)


UNUSABLE = {
    "in millimetres": (lambda v, f: (1000 * v, f), r"millimetres.*0\.001"),
    "too small": (lambda v, f: (v / 1000, f), "in kilometres it is 0.46 m"),
    "inches": (lambda v, f: (v / 0.0254, f), r"size is 18\.\d+.*in centimetres .*in inches .* \(scale it by 0\.0254\)"),
    "a person in feet": (lambda v, f: (v * (1.2, 3.9, 1.0) / 0.3048, f), r"size is 5\.88.*in feet it is 1\.8 m"),
    "degenerate": (lambda v, f: with_vertex(v, f, v[f[0][:2]].mean(axis=0)), "1 degenerate triangles"),
    "three triangles on an edge": (lambda v, f: with_vertex(v, f, (0.0, 0.0, 0.05)), "non-manifold: 1 edges"),
    "touch in a vertex": (mirrored, "touch in 1 single vertices"),
    "two pieces": (lambda v, f: (np.vstack((v, np.add(v, (0.6, 0, 0)))), np.vstack((f, f + len(v)))), "2 separate pieces"),
    "two holes": (with_two_holes, "it has 2 borders"),
    "umbilicus above": (lambda v, f: (np.add(v, (0, 0, 0.3)), f), "umbilicus must be at the origin"),
    "umbilicus inside": (lambda v, f: (np.add(BOX.vertices, (0, 0, 0.1)), BOX.faces), "umbilicus must be at the origin"),
}


@pytest.mark.parametrize(("change", "words"), UNUSABLE.values(), ids=UNUSABLE)
def test_an_unusable_mesh_is_refused_with_what_is_wrong(tmp_path, change, words):
    write(tmp_path / "wrong.ply", *change(*dome(3)))
    refused(tmp_path / "wrong.ply", words)


def test_a_moebius_strip_is_refused():
    angles = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    rim = [
        [(0.2 + s * np.cos(a / 2)) * np.cos(a), (0.2 + s * np.cos(a / 2)) * np.sin(a), s * np.sin(a / 2)]
        for a in angles
        for s in (-0.05, 0.05)
    ]
    faces = []
    for k in range(40):
        a, b = 2 * k, 2 * k + 1
        c, d = (2 * k + 2, 2 * k + 3) if k < 39 else (1, 0)
        faces += [[a, b, c], [b, d, c]]
    with pytest.raises(MeshError, match="not orientable"):
        orient(np.array(rim), np.array(faces, dtype=np.int32))


def test_a_mesh_too_fine_is_refused(tmp_path):
    vertices, faces = dome(5)
    write(tmp_path / "fine.ply", vertices, faces)
    with pytest.raises(MeshError, match="decimate"):
        build_phantom(Phantom(kind="mesh", mesh=str(tmp_path / "fine.ply"), edge_m=0.0025), 0)


def test_a_hole_before_the_camera_does_not_turn_the_body_inside_out(tmp_path):
    vertices, faces = dome(3)
    middle = vertices[faces].mean(axis=1)
    hole = np.argsort(np.linalg.norm(middle - (0.05, 0.05, -0.01), axis=1))[:6]
    model = build_phantom(write(tmp_path / "hole.ply", vertices, np.delete(faces, hole, axis=0)), 0)
    assert model.normals[np.argmin(np.linalg.norm(model.vertices, axis=1)), 2] > 0.99


def test_a_shallow_patch_can_move(tmp_path):
    vertices, faces = dome(4)
    patch = vertices * (1, 1, 0.05)
    model = build_phantom(write(tmp_path / "patch.ply", patch, front(vertices, faces)), 0)
    assert (~model.fixed).mean() > 0.8


def test_a_camera_may_look_straight_down():
    X = look_at(np.array((0.56, 0.0, 1.9)), np.array((0.56, 0.0, 0.9)))
    np.testing.assert_allclose(X[:3, :3].T @ X[:3, :3], np.eye(3), atol=1e-12)
    np.testing.assert_allclose(X[:3, 2], (0, 0, -1))
