"""Validation of the surface tier's numerics: convergence with the mesh, and superposition where the tissue is linear."""

from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure
from scipy.sparse.linalg import spsolve

from palpate_models.numerics.frames import Array
from palpate_models.patient.phantom import flat_phantom
from palpate_models.patient.schema import Lesion, Stiffness
from palpate_tissue.backends.winkler.tissue import WinklerTissue
from palpate_validation.check import COLOURS, INK, Check, PageSection
from palpate_validation.foundation import static_force, uniform
from palpate_validation.probing import ELASTIC, OFFSETS, hold


@dataclass(frozen=True)
class MeshSetup:
    """The meshes and presses."""

    half_m: float = 0.08
    edges_m: tuple[float, float] = (0.005, 0.0025)
    """Edges of the default mesh and of a mesh of half the edge."""
    radii_m: tuple[float, float] = (0.015, 0.020)
    from_m: float = 0.005
    """Least depth of the bound: shallower contacts are as small as an edge."""


SETUP = MeshSetup()

DEPTHS_M = np.array((2, 3, 5, 7.5, 10, 15)) * 1e-3


@dataclass(frozen=True)
class MeshForces:
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


@dataclass(frozen=True)
class Superposition:
    """Relative error of superposition where the tissue is linear."""

    static: float
    """Displacement under the forces of two contacts, solved directly, against the sum of both displacements."""
    recovery: float
    """Recovery from two dents together against the sum of the recoveries."""


def measure_superposition() -> Superposition:
    """Measure superposition of two dents, 30 mm apart, on a wall with a lesion."""
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
    return Superposition(float(static), float(np.abs(both - alone[0] - alone[1]).max() / np.abs(both).max()))


def _recover(model: object, start: Array, steps: int = 200) -> Array:
    """Return the displacement after recovery from `start` [m] without contact."""
    tissue = WinklerTissue(model, Stiffness())  # type: ignore[arg-type]
    tissue.displacement[:] = start
    tissue.disturbed = True
    for k in range(steps):
        tissue.idle(k * tissue.dt)
    return tissue.displacement.copy()


def section(meshes: MeshForces | None = None, linear: Superposition | None = None) -> PageSection:
    """Return convergence and superposition with their bounds."""
    meshes, linear = meshes or measure_meshes(), linear or measure_superposition()
    deep = SETUP.from_m - 1e-9 <= DEPTHS_M
    off = np.abs(meshes.force[1].mean(axis=1) / meshes.continuum - 1)
    checks = (
        Check(f"force change when the edge is halved, {SETUP.from_m * 1e3:g} to 15 mm",
              100 * float(np.abs(meshes.change[:, deep]).max()), "%", high=3.0, against="mesh of 2.5 mm"),
        Check("finer mesh, largest error", 100 * float(off[:, deep].max()), "%", high=1.5, against="continuum"),
        Check("largest difference of a position from the mean, from 5 mm", 100 * float(meshes.ripple[:, deep].max()), "%",
              against="mean over positions"),
        Check("static superposition, relative error", linear.static, high=1e-6, against="direct solution"),
        Check("superposition of viscoelastic recoveries, relative error", linear.recovery, high=1e-10, against="sum"),
    )  # fmt: skip
    text = (
        "The default mesh of 5 mm against one of 2.5 mm at the same five positions, and against the continuum. The displacement "
        "by the contact forces of two dents, solved directly with the stiffness matrix, is the sum of the displacements of "
        "two separate simulations, and two dents recover as the sum of their recoveries. The contact itself is not linear: "
        "its size grows with the depth."
    )
    data = {
        "edges_m": SETUP.edges_m, "radii_m": SETUP.radii_m, "depths_m": DEPTHS_M, "force_n": meshes.force,
        "continuum_n": meshes.continuum, "superposition": [linear.static, linear.recovery],
    }  # fmt: skip
    return PageSection("mesh", "Mesh and superposition", text, checks, lambda f: draw(f, meshes), (4.5, 2.8), data)


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
