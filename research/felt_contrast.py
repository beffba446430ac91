"""Force over a lump below the skin over the force without it, by axisymmetric finite elements.

python -m research.felt_contrast    # prints FINITE_ELEMENTS of benchmarks/palpate_validation/buried.py

It shares nothing with the tissue's tiers: Taylor-Hood elements of scikit-fem for nearly incompressible linear elasticity, a
slab that is bonded below, and a rigid sphere that meets it without friction. Contact is found by the active set: a node of the
skin that pulls is released, one that enters the sphere is held.
"""

import argparse
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.linalg import splu
from skfem import Basis, BilinearForm, ElementQuad1, ElementQuad2, ElementVector, MeshQuad, bmat
from skfem.helpers import ddot, sym_grad

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Press:
    """A sphere pressed into a slab over the middle of a lump."""

    sphere_m: float = 0.015
    depth_m: float = 0.010
    thickness_m: float = 0.12
    reach_m: float = 0.25
    """Radius of the slab."""
    poisson: float = 0.49
    edge_m: float = 0.008
    """Width in which the modulus rises to that of the lump."""
    fine_m: float = 0.002
    """Size of the elements under the sphere; half of it changes the ratios by 0.5 % at most."""


def coordinates(fine: float, near: float, end: float) -> Array:
    """Return element borders from 0 to `end`: `fine` apart up to `near`, then 15 % wider from one to the next."""
    borders = list(np.arange(0.0, near + fine / 2, fine))
    while borders[-1] + 1.15 * (borders[-1] - borders[-2]) < end:
        borders.append(borders[-1] + 1.15 * (borders[-1] - borders[-2]))
    return np.array([*borders[:-1], end])


def modulus(r: Array, z: Array, radius: float, top: float, contrast: float, edge: float) -> Array:
    """Return Young's modulus relative to the slab's at (r, z), z < 0 below the skin."""
    distance = np.hypot(r, z + top + radius) - radius
    t = np.clip(0.5 - distance / edge, 0.0, 1.0)
    return 1 + (contrast - 1) * t * t * (3 - 2 * t)


def force(press: Press, radius: float = 0.01, top: float = 0.0, contrast: float = 1.0) -> float:
    """Return the force on the sphere over the modulus of the slab [m^2]."""
    r, z = coordinates(press.fine_m, 0.045, press.reach_m), -coordinates(press.fine_m, 0.05, press.thickness_m)[::-1]
    mesh = MeshQuad.init_tensor(r, z)
    displacement, pressure = Basis(mesh, ElementVector(ElementQuad2()), intorder=4), Basis(mesh, ElementQuad1(), intorder=4)
    shear = 0.5 / (1 + press.poisson)
    ratio = (1 - 2 * press.poisson) / (2 * press.poisson)  # shear modulus over Lame's first parameter

    def relative(x: Array) -> Array:
        return modulus(x[0], x[1], radius, top, contrast, press.edge_m)

    @BilinearForm
    def stiffness(u, v, w):  # type: ignore[no-untyped-def]
        hoop = u.value[0] * v.value[0] / w.x[0] ** 2
        return 2 * shear * relative(w.x) * (ddot(sym_grad(u), sym_grad(v)) + hoop) * w.x[0]

    @BilinearForm
    def divergence(u, q, w):  # type: ignore[no-untyped-def]
        return -(u.grad[0, 0] + u.grad[1, 1] + u.value[0] / w.x[0]) * q * w.x[0]

    @BilinearForm
    def compressibility(p, q, w):  # type: ignore[no-untyped-def]
        return -p * q * ratio / (shear * relative(w.x)) * w.x[0]

    mixed = divergence.assemble(displacement, pressure)
    matrix = bmat([[stiffness.assemble(displacement), mixed.T], [mixed, compressibility.assemble(pressure)]], "csc")
    at, vertical = displacement.doflocs, np.zeros(matrix.shape[0], dtype=bool)
    vertical[displacement.split_indices()[1]] = True
    vertical = vertical[: at.shape[1]]
    bonded = np.flatnonzero((at[1] < -press.thickness_m + 1e-9) | ((at[0] < 1e-9) & ~vertical))
    skin = np.flatnonzero((at[1] > -1e-9) & vertical & (at[0] < press.sphere_m - 1e-6))
    wanted = press.sphere_m - press.depth_m - np.sqrt(press.sphere_m**2 - at[0, skin] ** 2)
    inside = wanted < 0.5 * wanted.min()
    for _ in range(40):
        held = np.concatenate((bonded, skin[inside]))
        free = np.setdiff1d(np.arange(matrix.shape[0]), held)
        x = np.zeros(matrix.shape[0])
        x[skin[inside]] = wanted[inside]
        x[free] = splu(matrix[free][:, free]).solve(-matrix[free] @ x)
        load = matrix[skin] @ x  # upward reaction of the skin is negative where it is pushed
        new = np.where(inside, load < 0, x[skin] > wanted)
        if (new == inside).all():
            return float(-2 * np.pi * load[inside].sum())
        inside = new
    raise RuntimeError("the contact does not settle")


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--fine", type=float, default=Press.fine_m, help="size of the elements under the sphere [m]")
    asked = parser.parse_args()
    press = Press(fine_m=asked.fine)
    plain = force(press)
    hertz = 4 / 3 / (1 - press.poisson**2) * np.sqrt(press.sphere_m) * press.depth_m**1.5
    print(f"without a lump: {plain / hertz:.3f} of Hertz's force on a half-space")
    for radius, top, contrast in product((0.010, 0.015, 0.020), (0.0, 0.005, 0.010, 0.020), (2.0, 4.0, 8.0)):
        print(radius, top, contrast, round(force(press, radius, top, contrast) / plain, 4), flush=True)


if __name__ == "__main__":
    main()
