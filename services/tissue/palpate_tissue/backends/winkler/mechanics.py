"""Matrices of the tissue, and the stability bound of its explicit step."""

import math
from typing import NamedTuple

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import ArpackNoConvergence, eigsh

from palpate_errors import UserError
from palpate_models.numerics.frames import Array
from palpate_models.patient import wall
from palpate_models.patient.phantom import PhantomModel
from palpate_models.patient.schema import Stiffness

STEP_LIMIT = 1.8
"""Maximum dt * rate of a step. Energy cannot grow below 2; above 1.8 the finest waves would ring for ten steps or more."""
MOST_SUBSTEPS = 64


class Mechanics(NamedTuple):
    """Matrices of `C u' + K (u - sum_k y_k) + k_w A (sigma(u) + tension a max(u, 0)) = f` on the free vertices."""

    stiffness: sparse.csr_array
    """K = diag(k_w A) + L[G], instantaneous [N/m], shape (n, n); rows and columns of fixed vertices are empty."""
    damping: Array
    """Diagonal of C [N s/m], shape (n,)."""
    rate: float
    """Maximum eigenvalue of C^-1 K [1/s], with the nonlinear springs at their largest stiffness."""

    def substeps(self, dt: float) -> int:
        """Return the number of equal explicit steps per period `dt` [s] for which each is stable and passive.

        Raises UserError if it exceeds `MOST_SUBSTEPS`.
        """
        count = max(1, math.ceil(dt * self.rate / STEP_LIMIT))
        if count > MOST_SUBSTEPS:
            raise UserError(
                f"tissue: {count} sub-steps per period of {dt * 1e3:g} ms needed (dt * rate = {dt * self.rate:.3g}, "
                f"limit {STEP_LIMIT}), at most {MOST_SUBSTEPS} allowed: use a coarser mesh (phantom.edge_m), a shorter "
                "phantom.stiffness.length_m or a larger phantom.stiffness.dashpot_s"
            )
        return count


def stiffness_matrix(model: PhantomModel, stiffness: Stiffness) -> sparse.csr_array:
    """Return K of a phantom.

    Pasternak's G = k_w l^2 varies with k_w. An edge between two vertices carries the harmonic mean of their G, as between cells
    of a finite-volume scheme: both halves carry the same shear. It also keeps the bound low at sharp contrasts. Fixed vertices
    keep u = 0.
    """
    free = ~model.fixed
    edges = sparse.coo_array(model.laplacian)
    i, j, weight = edges.coords[0], edges.coords[1], -edges.data
    keep = (i != j) & (free[i] | free[j])
    i, j, weight = i[keep], j[keep], weight[keep]
    shear = model.stiffness * stiffness.length_m**2
    carried = weight * 2 * shear[i] * shear[j] / (shear[i] + shear[j])
    n = len(model.vertices)
    diagonal = model.stiffness * model.areas + np.bincount(i, carried, n)
    inner = free[i] & free[j]
    index = np.flatnonzero(free)
    values, rows, columns = np.append(diagonal[index], -carried[inner]), np.append(index, i[inner]), np.append(index, j[inner])
    matrix = sparse.csr_array((values, (rows, columns)), shape=(n, n))
    matrix.sort_indices()
    return matrix


def assemble(model: PhantomModel, stiffness: Stiffness) -> Mechanics:
    """Return the matrices of a phantom."""
    matrix = stiffness_matrix(model, stiffness)
    damping = stiffness.dashpot_s * model.stiffness * model.areas
    adjacent = wall.largest_slope(model.stiffening, model.tension)
    hardest = matrix + sparse.diags_array(np.where(~model.fixed, model.stiffness * model.areas * adjacent, 0.0))
    return Mechanics(matrix, damping, _largest_rate(hardest, damping))


def _largest_rate(matrix: sparse.csr_array, damping: Array) -> float:
    """Return the largest eigenvalue of C^-1 K by Lanczos with a 1 % margin; Gershgorin's bound if it does not converge."""
    bound = float((abs(matrix).sum(axis=1) / damping).max())
    scale = sparse.diags_array(1 / np.sqrt(damping))
    try:
        start = 1 + np.arange(len(damping)) % 7 / 7.0  # fixed start: runs repeat
        largest = eigsh(scale @ matrix @ scale, k=1, which="LA", v0=start, tol=1e-3, return_eigenvectors=False)[0]
    except ArpackNoConvergence:
        return bound
    return float(min(1.01 * largest, bound))
