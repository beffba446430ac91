"""Expected information: how much one more press is going to tell about where a lump is, and whether there is one.

It is the mutual information of the hypothesis h and the next observation y,

    I = H(y) - sum_h p_h H(y | h),

in nats. Under each hypothesis y is Gaussian, so that H(y | h) is a formula and y a mixture, whose entropy is a sum over a grid
(Lindley 1956; MacKay 1992, "Information-based objective functions for active data selection").
"""

from __future__ import annotations

import numpy as np

from palpate_models.compiled import compiled
from palpate_models.frames import Array

_NODES = 25
_REACH = 4.0
"""The grid reaches so many standard deviations beyond the mixture."""
_RARE = 2e-5
"""Hypotheses less probable than this count as no lump."""
_SAME = 0.02
"""Hypotheses that change the observation by less than this part of its standard deviation count as no lump."""


@compiled
def information(unexplained: Array, contrast: Array, contrast_variance: Array, probability: Array, variance: Array) -> Array:
    """Information of an observation at each place [nat], shape (p,).

    `unexplained`: shape (p, h), what a lump of log-contrast 1 adds to the mean; `contrast` and its variance, shape (h,);
    `probability` of each hypothesis, shape (h,); `variance` of the observation without a lump, shape (p,).
    """
    places, hypotheses = unexplained.shape
    out = np.zeros(places)
    mean, sd, weight = np.empty(hypotheses + 1), np.empty(hypotheses + 1), np.empty(hypotheses + 1)
    for i in range(places):
        count = 1
        mean[0], sd[0], rest = 0.0, np.sqrt(variance[i]), 1.0
        low, high = -_REACH * sd[0], _REACH * sd[0]
        for h in range(hypotheses):
            shift = contrast[h] * unexplained[i, h]
            if probability[h] > _RARE and abs(shift) > _SAME * sd[0]:
                mean[count] = shift
                sd[count] = np.sqrt(variance[i] + contrast_variance[h] * unexplained[i, h] ** 2)
                weight[count] = probability[h]
                rest -= probability[h]
                low, high = min(low, shift - _REACH * sd[count]), max(high, shift + _REACH * sd[count])
                count += 1
        if count == 1:
            continue
        weight[0] = max(rest, 0.0)
        given = 0.0
        for k in range(count):
            given += weight[k] * (0.5 * np.log(2 * np.pi * np.e) + np.log(sd[k]))
        step = (high - low) / (_NODES - 1)
        entropy = 0.0
        for node in range(_NODES):
            y, density = low + node * step, 0.0
            for k in range(count):
                density += weight[k] / (np.sqrt(2 * np.pi) * sd[k]) * np.exp(-0.5 * ((y - mean[k]) / sd[k]) ** 2)
            if density > 1e-300:
                entropy -= density * np.log(density) * step
        out[i] = max(entropy - given, 0.0)
    return out
