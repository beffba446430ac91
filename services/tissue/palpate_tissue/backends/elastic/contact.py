"""Unilateral contact of an elastic solid: the forces that keep its skin out of a rigid body."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, cho_factor, cho_solve

from palpate_models.numerics.frames import Array

Mask = NDArray[np.bool_]

_GUESSES = 25
"""Rounds of the quick rule; then the rule that always ends takes over."""
_MOST = 20_000


class ContactError(RuntimeError):
    """The contact problem was not solved: the compliance is not positive definite."""


class ContactSolver:
    """Finds f with  A f - b >= 0,  f >= 0,  f (A f - b) = 0  for a positive definite A, beginning with the last contact set.

    A contact set is guessed, its forces solved for, and the set corrected where a force pulls or a gap is closed (primal-dual
    active set; Hintermueller, Ito and Kunisch 2002). If that does not settle, vertices are corrected one at a time, the
    least first, which ends for every positive definite A (Murty 1974).
    """

    def __init__(self, matrix: Array) -> None:
        self.matrix = matrix
        """A, shape (m, m), symmetric and positive definite."""
        self.active: Mask = np.zeros(len(matrix), dtype=np.bool_)
        """The contact set of the last solution, shape (m,)."""
        self._index = np.empty(0, dtype=np.intp)
        self._inverse = np.empty((0, 0))
        self._columns = np.empty((len(matrix), 0))

    def begin_with(self, active: Mask) -> None:
        """Another contact set to begin with, shape (m,)."""
        if not np.array_equal(active, self.active):
            self._choose(active)

    def solve(self, b: Array) -> tuple[Array, Array]:
        """Forces f and A f for a right-hand side, each of shape (m,)."""
        force = np.zeros(len(b))
        if not self.active.any() and (b <= 0).all():
            return force, np.zeros(len(b))
        noise = 1e-12 * float(np.abs(b).max())
        for attempt in range(_MOST):
            if len(self._index):
                pressed = self._inverse.dot(b.take(self._index))
                moved = self._columns.dot(pressed)
            else:
                pressed, moved = np.empty(0), np.zeros(len(b))
            wrong = moved < b - noise
            wrong[self._index] = pressed < 0
            if not wrong.any():
                force[self._index] = pressed
                return force, moved
            if attempt < _GUESSES:
                self._choose(self.active ^ wrong)
            else:
                one = np.zeros_like(wrong)
                one[int(wrong.argmax())] = True
                self._choose(self.active ^ one)
        raise ContactError(f"no contact set in {_MOST} rounds on {len(b)} vertices")

    def _choose(self, active: Mask) -> None:
        self.active = active
        self._index = np.flatnonzero(active)
        if len(self._index):
            self._columns = self.matrix.take(self._index, axis=1)
            try:
                factor = cho_factor(self._columns.take(self._index, axis=0), lower=True, check_finite=False)
            except LinAlgError as error:
                raise ContactError(
                    "the compliance is not positive definite: the mesh has vertices much nearer to each other than its triangles "
                    "are wide; remesh it evenly, or services.tissue = winkler"
                ) from error
            self._inverse = cho_solve(factor, np.eye(len(self._index)), check_finite=False)
