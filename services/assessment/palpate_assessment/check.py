"""Posterior predictive check: each piece of a stroke against its prediction from all others.

With the covariance K of all observations and P = K^-1, the piece k held out has the residual e = (P_kk)^-1 (P y)_k with
covariance (P_kk)^-1 (Rasmussen and Williams 2006, sec. 5.4.2), so e' P_kk e is chi-squared if the model holds.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from palpate_assessment.model import Regression, inverse
from palpate_assessment.observations import Observations

SURPRISE = 1e-5
"""A piece whose residual is less probable than this contradicts the model: of an examination's hundred pieces, one in a thousand
examinations where the model holds."""


def contradicted(regression: Regression) -> NDArray[np.bool_]:
    """Return the mask of samples in a piece of a stroke that the others contradict, shape (m,)."""
    o = regression.observations
    precision = inverse(regression.triangle)
    pull = precision @ (o.y - regression.level)
    marked = np.zeros(len(o.y), dtype=bool)
    for piece in pieces(o):
        own = pull[piece]
        surprise = float(own @ np.linalg.solve(precision[np.ix_(piece, piece)], own))
        marked[piece] = chdtrc(len(piece), surprise) < SURPRISE
    return marked


def pieces(o: Observations) -> list[NDArray[np.intp]]:
    """Indices of the samples of each piece: strokes cut at every `piece_m` of travel."""
    step = np.hypot(*np.diff(o.xy, axis=0, prepend=o.xy[:1]).T)
    travel = np.cumsum(np.where(np.diff(o.stroke, prepend=o.stroke[0]) == 0, step, 0.0))
    start = np.array([travel[o.stroke == stroke].min() for stroke in o.stroke])
    key = np.column_stack((o.stroke, np.floor((travel - start) / o.standard.lengths.piece_m)))
    _, group = np.unique(key, axis=0, return_inverse=True)
    return [np.flatnonzero(group.ravel() == g) for g in range(int(group.max()) + 1)]
