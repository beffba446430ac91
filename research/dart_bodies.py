"""DART's own soft bodies, the paper's kind, against our tissue with the same springs: force against depth, and cost."""

import time
from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy import sparse

from palpate_models.numerics.frames import Array
from palpate_models.patient.phantom import PhantomModel
from palpate_models.patient.schema import Stiffness
from palpate_tissue.backends.winkler.tissue import WinklerTissue
from palpate_validation.check import COLOURS, Check, PageSection, show
from palpate_validation.drop import DartScene, Ellipsoid, Flesh, SoftBox
from palpate_validation.probing import STILL

IntArray = NDArray[np.int32]

AREA_M2 = 2.5e-5
"""Area of a vertex [m^2]; any value gives the same tissue."""


def twin(flesh: Flesh) -> WinklerTissue:
    """Our tissue with the same vertices and parameters, without friction and relaxation."""
    if isinstance(flesh.shape, SoftBox):
        vertices, normals = box_surface(flesh.shape)
        edges = np.empty((0, 2), dtype=np.int32)
    else:
        vertices, normals = ellipsoid_surface(flesh.shape)
        edges = ellipsoid_edges(flesh.shape)
    n = len(vertices)
    k_w = np.full(n, flesh.k_v / AREA_M2)
    model = PhantomModel(
        vertices=vertices,
        triangles=np.empty((0, 3), dtype=np.int32),
        normals=normals,
        areas=np.full(n, AREA_M2),
        laplacian=graph_laplacian(edges, n),
        stiffness=k_w,
        background=k_w,
        lesion=np.full(n, -1, dtype=np.int32),
        fixed=np.zeros(n, dtype=np.bool_),
        breathing=np.zeros(n),
        stiffening=np.zeros(n),
        tension=np.zeros(n),
    )
    length = float(np.sqrt(flesh.k_e / k_w[0])) if len(edges) else Stiffness().length_m
    wall = Stiffness(
        k_w_n_per_m3=float(k_w[0]), length_m=length, dashpot_s=flesh.damping / flesh.k_v, prony_g=(), prony_tau_s=(), friction=0.0
    )
    return WinklerTissue(model, wall)


def graph_laplacian(edges: IntArray, n: int) -> sparse.csr_array:
    """Degree matrix minus adjacency, shape (n, n), of undirected edges (m, 2)."""
    i, j = np.concatenate((edges, edges[:, ::-1])).T
    adjacency = sparse.coo_array((np.ones(len(i)), (i, j)), shape=(n, n)).tocsr()
    return sparse.csr_array(sparse.diags_array(np.asarray(adjacency.sum(axis=1)).ravel()) - adjacency)


def box_surface(box: SoftBox) -> tuple[Array, Array]:
    """Vertices (n, 3) [m] of a box whose top is in z = 0, and outward normals; the rim of the top belongs to the top."""
    grids = [np.linspace(-size / 2, size / 2, count) for size, count in zip(box.size_m, box.counts, strict=True)]
    points = np.stack(np.meshgrid(*grids, indexing="ij"), axis=-1).reshape(-1, 3)
    side = points / (np.array(box.size_m) / 2)  # components of 1 on the surface
    on = np.isclose(np.abs(side), 1)
    surface = on.any(axis=1)
    points, side, on = points[surface], side[surface], on[surface]
    axis = np.where(on[:, 2], 2, np.argmax(on, axis=1))
    normals = np.zeros_like(points)
    normals[np.arange(len(points)), axis] = np.sign(side[np.arange(len(points)), axis])
    points[:, 2] -= box.size_m[2] / 2
    return points, normals


def ellipsoid_surface(ellipsoid: Ellipsoid) -> tuple[Array, Array]:
    """Vertices (n, 3) [m] of an ellipsoid whose pole is the origin, in DART's order, and outward normals."""
    half = np.array(ellipsoid.size_m) / 2
    polar = np.pi * np.arange(1, ellipsoid.stacks) / ellipsoid.stacks
    around = 2 * np.pi * np.arange(ellipsoid.slices) / ellipsoid.slices
    p, a = (grid.ravel() for grid in np.meshgrid(polar, around, indexing="ij"))
    rings = np.column_stack((-np.sin(p) * np.sin(a), np.sin(p) * np.cos(a), np.cos(p)))
    unit = np.concatenate(([[0.0, 0.0, 1.0]], rings, [[0.0, 0.0, -1.0]]))
    normals = unit / half
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    vertices = unit * half
    vertices[:, 2] -= half[2]
    return vertices, normals


def ellipsoid_edges(ellipsoid: Ellipsoid) -> IntArray:
    """Return the edges between vertices in DART: along meridians and rings, and across both diagonals; shape (m, 2)."""
    slices, rings = ellipsoid.slices, ellipsoid.stacks - 1
    index = 1 + np.arange(rings * slices).reshape(rings, slices)
    turned = np.roll(index, -1, axis=1)
    last = rings * slices + 1
    pairs = [
        np.column_stack((np.zeros(slices, dtype=int), index[0])),
        np.column_stack((np.full(slices, last), index[-1])),
        np.column_stack((index[:-1].ravel(), index[1:].ravel())),
        np.column_stack((index.ravel(), turned.ravel())),
        np.column_stack((index[:-1].ravel(), turned[1:].ravel())),
        np.column_stack((turned[:-1].ravel(), index[1:].ravel())),
    ]
    return np.concatenate(pairs).astype(np.int32)


RADIUS_M = 0.020
DT = 1e-3
SPEED_MPS = 0.02
SETTLE_S, MEAN_S = 0.5, 0.2
"""A depth is held for the first, then the force is averaged over the second."""
DEPTHS_M = np.array((2, 4, 6, 8, 10)) * 1e-3
BOX = Flesh(SoftBox((0.1, 0.1, 0.05), (21, 21, 3)), k_v=4.25, k_e=0.0, damping=0.6, mass=0.02)
"""Vertices 5 mm apart with the default wall's k_w: 962 point masses."""
ELLIPSOID = Flesh(Ellipsoid((0.3, 0.3, 0.1), 16, 60), k_v=4.25, k_e=4.0, damping=0.6, mass=0.02)
"""946 point masses; the pole is nearly flat, radius of curvature 0.45 m."""


@dataclass(frozen=True)
class ForceCurve:
    """Static force at each depth of `DEPTHS_M`, and the cost of a step in contact."""

    force: Array
    """[N], shape (depths,)"""
    step_us: float
    """Fastest tenth of the held steps at 10 mm [us]: what a busy machine disturbs least."""


def press_dart(flesh: Flesh, friction: float, depths: Array = DEPTHS_M) -> ForceCurve:
    """Press DART's soft body. The force is freed of DART's time-step factor (see `Flesh.at_rest`)."""
    scene = DartScene(flesh, RADIUS_M, DT, friction=friction)
    forces: list[float] = []
    costs: list[float] = []
    for depth in depths:
        while scene.depth < depth - 1e-9:
            scene.move(-min(SPEED_MPS, (depth - scene.depth) / DT))
        held, costs = [], []
        for k in range(round((SETTLE_S + MEAN_S) / DT)):
            begin = time.perf_counter()
            scene.move(0.0)
            costs.append(time.perf_counter() - begin)
            if k * DT >= SETTLE_S:
                held.append(scene.force())
        forces.append(float(np.mean(held)))
    return ForceCurve(np.array(forces) / flesh.at_rest(DT), 1e6 * float(np.percentile(costs, 10)))


def press_ours(flesh: Flesh, depths: Array = DEPTHS_M) -> ForceCurve:
    """Press our tissue with the same vertices and springs, in the same way."""
    tissue = twin(flesh)
    forces: list[float] = []
    costs: list[float] = []
    for depth in depths:
        p = np.array((0.0, 0.0, RADIUS_M - depth))
        costs = []
        for _ in range(round((SETTLE_S + MEAN_S) / DT)):
            begin = time.perf_counter()
            force, _ = tissue.step(0.0, p, STILL, RADIUS_M)
            costs.append(time.perf_counter() - begin)
        forces.append(float(force[2]))
    return ForceCurve(np.array(forces), 1e6 * float(np.percentile(costs, 10)))


def sliding_vertices(flesh: Flesh, depths: Array = DEPTHS_M) -> Array:
    """Exact static force [N] of a flat body without edges and friction, each vertex free to move sideways, shape (depths,).

    A vertex inside the sphere moves to its surface along the radius; k_v times the way is its force, whose upward part counts.
    """
    if not isinstance(flesh.shape, SoftBox):
        raise TypeError("sliding_vertices: only for a box")
    size, count = flesh.shape.size_m[0], flesh.shape.counts[0]
    grid = np.linspace(-size / 2, size / 2, count)
    lateral2 = (grid[:, None] ** 2 + grid[None, :] ** 2).ravel()
    up = RADIUS_M - depths[:, None]
    distance = np.sqrt(lateral2 + up**2)
    return np.asarray((flesh.k_v * np.maximum(RADIUS_M - distance, 0) * up / distance).sum(axis=1))


@dataclass(frozen=True)
class Bodies:
    """All curves of the comparison."""

    box: ForceCurve
    box_ours: ForceCurve
    box_slippery: ForceCurve
    ellipsoid: ForceCurve
    ellipsoid_ours: ForceCurve


def measure(depths: Array = DEPTHS_M) -> Bodies:
    """Press each body in DART and in ours."""
    return Bodies(
        press_dart(BOX, 1.0, depths), press_ours(BOX, depths), press_dart(BOX, 0.0, depths),
        press_dart(ELLIPSOID, 1.0, depths), press_ours(ELLIPSOID, depths),
    )  # fmt: skip


def section(bodies: Bodies | None = None, depths: Array = DEPTHS_M) -> PageSection:
    """Return the comparison with its bounds."""
    bodies = bodies or measure(depths)
    exact = sliding_vertices(BOX, depths)

    def worst(a: Array, b: Array) -> float:
        return 100 * float(np.abs(a / b - 1).max())

    checks = (
        Check("box, sticking: difference", worst(bodies.box_ours.force, bodies.box.force), "%", high=4.0, against="DART"),
        Check("ellipsoid with edges: difference", worst(bodies.ellipsoid_ours.force, bodies.ellipsoid.force), "%", high=5.0,
              against="DART"),
        Check("box, no friction: DART below ours at the greatest depth",
              100 * float(1 - bodies.box_slippery.force[-1] / bodies.box_ours.force[-1]), "%", against="DART"),
        Check("the same, explained: DART against vertices that slide sideways", worst(bodies.box_slippery.force, exact), "%",
              high=4.0, against="exact statics"),
        Check("force that DART's impulses leave out at this step", 100 * (1 - BOX.at_rest(DT)), "%", against="its source"),
        Check("DART, box: cost of a step", bodies.box.step_us, "us", timed=True),
        Check(f"ours, the same {BOX.shape.vertices} vertices: cost of a step", bodies.box_ours.step_us, "us", timed=True),
        Check("ours is cheaper, box", bodies.box.step_us / bodies.box_ours.step_us, "times", low=20, against="DART", timed=True),
        Check(f"ours is cheaper, ellipsoid ({ELLIPSOID.shape.vertices} vertices)",
              bodies.ellipsoid.step_us / bodies.ellipsoid_ours.step_us, "times", low=20, against="DART", timed=True),
    )  # fmt: skip
    text = (
        "The same vertices, k_v, k_e and damping in DART (loaded by its SKEL parser) and in our tissue, pressed by the same "
        "sphere of "
        "20 mm. While the skin sticks to the sphere (friction 1) both give the same force. Without friction DART's vertices, "
        "free in "
        "three coordinates, slide out sideways under the sphere and it reads less: exactly what the statics of such vertices "
        "demand. Ours move along the normal only, as if held by the tissue around them (why: services/tissue/README.md). "
        "Found on the way: DART's boxes have no edges, so k_e does nothing in them (its ellipsoids have them), and "
        "its reported contact forces at rest are short by the factor m / (m + h damping + h^2 k_v), which is taken out here."
    )
    data = {
        "depths_m": depths, "box_dart_n": bodies.box.force, "box_ours_n": bodies.box_ours.force,
        "box_slippery_dart_n": bodies.box_slippery.force, "box_slippery_exact_n": exact,
        "ellipsoid_dart_n": bodies.ellipsoid.force, "ellipsoid_ours_n": bodies.ellipsoid_ours.force,
    }  # fmt: skip
    return PageSection("dart", "DART's soft bodies", text, checks, lambda f: draw(f, bodies, exact, depths), data=data)


def draw(figure: Figure, bodies: Bodies, exact: Array, depths: Array) -> None:
    """Force against depth: box on the left, ellipsoid on the right."""
    left, right = figure.subplots(1, 2)
    mm = depths * 1e3
    left.plot(mm, bodies.box_ours.force, color=COLOURS[0], lw=1, label="ours")
    left.plot(mm, bodies.box.force, "o", color=COLOURS[1], ms=4, label="DART, friction 1")
    left.plot(mm, bodies.box_slippery.force, "s", color=COLOURS[2], ms=3.5, label="DART, no friction")
    left.plot(mm, exact, color=COLOURS[2], lw=0.8, ls="--", label="statics of sliding vertices")
    left.set(xlabel="depth [mm]", ylabel="force [N]", title="box, k_v only")
    right.plot(mm, bodies.ellipsoid_ours.force, color=COLOURS[0], lw=1, label="ours")
    right.plot(mm, bodies.ellipsoid.force, "o", color=COLOURS[1], ms=4, label="DART, friction 1")
    right.set(xlabel="depth [mm]", title="ellipsoid, k_v and k_e")
    for axes in (left, right):
        axes.legend()


if __name__ == "__main__":
    show(section())
