"""Validation of the surface tier's numerics: convergence with the mesh, lumps, and superposition where the tissue is linear.

The reference for mesh and lumps are axisymmetric finite elements of the tier's equations that share no code with the tissue:

    k_w u - (1/r) (r G u')' = p,    p >= 0,  u >= w(r),  p (u - w) = 0,    w(r) = d - R + sqrt(R^2 - r^2)
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure
from scipy import sparse
from scipy.sparse.linalg import spsolve

from palpate_models.numerics.frames import Array
from palpate_models.patient.phantom import PhantomModel, flat_phantom
from palpate_models.patient.schema import Lesion, Stiffness
from palpate_tissue.backends.winkler.tissue import WinklerTissue
from palpate_validation.check import COLOURS, INK, Check, PageSection
from palpate_validation.probing import ELASTIC, OFFSETS, hold


class MeshSetup(NamedTuple):
    """The meshes and presses."""

    half_m: float = 0.08
    edges_m: tuple[float, float] = (0.005, 0.0025)
    """Edges of the default mesh and of a mesh of half the edge."""
    radii_m: tuple[float, float] = (0.015, 0.020)
    from_m: float = 0.005
    """Minimum depth of the bound: shallower contacts are as small as an edge."""
    lumps_m: tuple[float, float, float] = (0.010, 0.020, 0.030)
    contrasts: tuple[float, float, float] = (2.0, 4.0, 10.0)
    lump_edge_m: float = 0.008
    """Default width of a lesion's edge."""


SETUP = MeshSetup()

Profile = Callable[[Array], Array]

OUTER_M = 0.12
"""Radius at which the surface is fixed: eight Pasternak lengths."""
MOST_ITERATIONS = 200


def uniform(value: float) -> Profile:
    """Return a constant profile."""
    return lambda r: np.full_like(r, value)


def lump(value: float, radius: float, contrast: float, edge: float) -> Profile:
    """Return a profile of `value`, times `contrast` inside `radius` [m], with a cubic edge of width `edge` [m] centred there."""

    def profile(r: Array) -> Array:
        t = np.clip(0.5 - (r - radius) / edge, 0.0, 1.0)
        return value * (1 + (contrast - 1) * t * t * (3 - 2 * t))

    return profile


def static_force(depth: float, radius: float, k_w: Profile, shear: Profile, h: float = 2e-4) -> float:
    """Return the force [N] on a frictionless sphere of `radius` at `depth` [m]; `k_w` [N/m^3] and G = `shear` [N/m] over r [m].

    Linear elements of length `h` [m], lumped foundation, contact by the primal-dual active set method (Hintermueller, Ito
    and Kunisch 2002). Raises RuntimeError if the contact set does not settle.
    """
    r = np.arange(0, OUTER_M + h / 2, h)
    middle = (r[1:] + r[:-1]) / 2
    spring = shear(middle) * 2 * np.pi * middle / h
    area = 2 * np.pi * r * h
    area[0], area[-1] = np.pi * (h / 2) ** 2, np.pi * r[-1] * h
    slope = sparse.eye_array(len(middle), len(r), k=1) - sparse.eye_array(len(middle), len(r))
    stiffness = (slope.T @ sparse.diags_array(spring) @ slope + sparse.diags_array(k_w(r) * area)).tocsc()
    hold = np.where(r < radius, depth - radius + np.sqrt(np.maximum(radius**2 - r**2, 0)), -1.0)
    active = hold > 0
    for _ in range(MOST_ITERATIONS):
        free = ~active
        free[-1] = False  # u = 0 at the outer end
        u = np.where(active, hold, 0.0)
        u[free] = spsolve(stiffness[free][:, free], -(stiffness @ u)[free])
        f = stiffness @ u
        new = np.where(active, f > 0, hold > u)
        new[-1] = False
        if (new == active).all():
            return float(f[active].sum())
        active = new
    raise RuntimeError(f"foundation: no contact set after {MOST_ITERATIONS} iterations at depth {depth} m")


DEPTHS_M = np.array((2, 3, 5, 7.5, 10, 15)) * 1e-3


class MeshForces(NamedTuple):
    """Static forces [N], shape (edges, radii, places, depths), and of the continuum, shape (radii, depths)."""

    force: Array
    continuum: Array

    @property
    def change(self) -> Array:
        """Relative change of force from the finer to the default mesh, mean over positions, shape (radii, depths)."""
        mean = self.force.mean(axis=2)
        return np.asarray(mean[0] / mean[1] - 1)

    @property
    def ripple(self) -> Array:
        """Largest relative difference of a position from the mean over positions, default mesh, shape (radii, depths)."""
        return np.asarray(np.abs(self.force[0] / self.force[0].mean(axis=1, keepdims=True) - 1).max(axis=1))


def measure_meshes() -> MeshForces:
    """Press both meshes at the same positions."""
    wall = ELASTIC
    force = np.empty((len(SETUP.edges_m), len(SETUP.radii_m), len(OFFSETS), len(DEPTHS_M)))
    for e, edge in enumerate(SETUP.edges_m):
        model = flat_phantom(SETUP.half_m, edge)
        for r, radius in enumerate(SETUP.radii_m):
            for o, xy in enumerate(OFFSETS):
                tissue = WinklerTissue(model, ELASTIC)
                force[e, r, o] = [hold(tissue, float(depth), radius, xy, 0.2) for depth in DEPTHS_M]
    k_w, shear = uniform(wall.k_w_n_per_m3), uniform(wall.k_w_n_per_m3 * wall.length_m**2)
    continuum = np.array([[static_force(float(d), radius, k_w, shear) for d in DEPTHS_M] for radius in SETUP.radii_m])
    return MeshForces(force, continuum)


def measure_superposition() -> tuple[float, float]:
    """Return the relative errors of superposition of two dents, 30 mm apart, on a wall with a lesion.

    Static: displacement under the forces of both contacts, solved directly, against the sum of both displacements. Recovery from
    both dents together against the sum of the recoveries.
    """
    model = flat_phantom(SETUP.half_m, lesions=(Lesion(centre_m=(0.01, 0.0), radii_m=(0.02, 0.02)),))
    places = ((-0.015, 0.003), (0.015, -0.004))
    displacement, load = np.zeros((2, len(model.vertices))), np.zeros((2, len(model.vertices)))
    for k, xy in enumerate(places):
        tissue = WinklerTissue(model, ELASTIC)
        hold(tissue, 0.008, 0.015, xy, 1.5)
        displacement[k] = tissue.displacement
        load[k, tissue.contacts] = tissue.contact_forces
    free = ~model.fixed
    stiffness = tissue.mechanics.stiffness.tocsc()[free][:, free]
    together = spsolve(stiffness, load.sum(axis=0)[free])
    static = np.abs(together - displacement.sum(axis=0)[free]).max() / displacement.max()
    alone = [_recover(model, u) for u in displacement]
    both = _recover(model, displacement.sum(axis=0))
    return float(static), float(np.abs(both - alone[0] - alone[1]).max() / np.abs(both).max())


def _recover(model: PhantomModel, start: Array, steps: int = 200) -> Array:
    """Return the displacement after recovery from `start` [m] without contact."""
    tissue = WinklerTissue(model, Stiffness())
    tissue.displacement[:] = start
    tissue.disturbed = True
    for k in range(steps):
        tissue.idle(k * tissue.dt)
    return tissue.displacement.copy()


def measure_lumps() -> Array:
    """Return the force over the middle of a lump relative to that without it, over the continuum's ratio; (lumps, contrasts)."""
    radius, depth, k_w = SETUP.radii_m[1], 0.010, ELASTIC.k_w_n_per_m3

    def tissue(*lesions: Lesion) -> float:
        return hold(WinklerTissue(flat_phantom(lesions=lesions), ELASTIC), depth, radius)

    def continuum(stiffness: Profile) -> float:
        return static_force(depth, radius, stiffness, lambda r: stiffness(r) * ELASTIC.length_m**2)

    def ratio(lump_m: float, contrast: float) -> float:
        edge = SETUP.lump_edge_m
        lesion = Lesion(centre_m=(0.0, 0.0), radii_m=(lump_m, lump_m), contrast=contrast, edge_m=edge)
        return tissue(lesion) / continuum(lump(k_w, lump_m, contrast, edge))

    plain = tissue() / continuum(uniform(k_w))
    return np.array([[ratio(lump_m, contrast) for contrast in SETUP.contrasts] for lump_m in SETUP.lumps_m]) / plain


def section() -> PageSection:
    """Return convergence, lumps and superposition with their bounds."""
    meshes, lumps, (static, recovery) = measure_meshes(), measure_lumps(), measure_superposition()
    deep = SETUP.from_m - 1e-9 <= DEPTHS_M
    off = np.abs(meshes.force[1].mean(axis=1) / meshes.continuum - 1)
    checks = (
        Check(f"force change when the edge is halved, {SETUP.from_m * 1e3:g} to 15 mm",
              100 * float(np.abs(meshes.change[:, deep]).max()), "%", high=3.0, against="mesh of 2.5 mm"),
        Check("finer mesh, largest error", 100 * float(off[:, deep].max()), "%", high=1.5, against="continuum"),
        Check("largest difference of a position from the mean, from 5 mm", 100 * float(meshes.ripple[:, deep].max()), "%",
              against="mean over positions"),
        Check("largest error of a lump's force ratio, 10 mm deep", 100 * float(np.abs(lumps - 1).max()), "%", high=4.0,
              against="continuum"),
        Check("static superposition, relative error", static, high=1e-6, against="direct solution"),
        Check("superposition of viscoelastic recoveries, relative error", recovery, high=1e-10, against="sum"),
    )  # fmt: skip
    text = (
        "The default mesh of 5 mm against one of 2.5 mm at the same five positions, and against the continuum, "
        "also over the middle of lumps of 10 to 30 mm, 2 to 10 times as stiff. The displacement "
        "by the contact forces of two dents, solved directly with the stiffness matrix, is the sum of the displacements of "
        "two separate simulations, and two dents recover as the sum of their recoveries. The contact itself is not linear: "
        "its size grows with the depth."
    )
    return PageSection("mesh", "Mesh and superposition", text, checks, lambda f: draw(f, meshes), (4.5, 2.8))


def draw(figure: Figure, meshes: MeshForces) -> None:
    """Draw force relative to the continuum, for both meshes and all positions."""
    axes = figure.subplots()
    mm = DEPTHS_M * 1e3
    for r, radius in enumerate(SETUP.radii_m):
        for e, edge in enumerate(SETUP.edges_m):
            ratio = meshes.force[e, r] / meshes.continuum[r]
            colour = COLOURS[2 * e + r] if e else COLOURS[r]
            axes.fill_between(mm, ratio.min(axis=0), ratio.max(axis=0), color=colour, alpha=0.15, lw=0)
            label = f"edge {edge * 1e3:g} mm, R = {radius * 1e3:g} mm"
            axes.plot(mm, ratio.mean(axis=0), "o-", color=colour, ms=2.5, lw=1, label=label)
    axes.axhline(1, color=INK, lw=0.6)
    axes.set(xlabel="depth [mm]", ylabel="force relative to the continuum")
    axes.legend()
