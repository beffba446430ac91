"""Relaxation of the wall along the indenter's path: how much of the instantaneous force is left.

With a Prony series the stress is that of u - sum g_i q_i, dq_i/dt = (u - q_i) / tau_i. What the wall remembers of an
indentation at another place and time acts on the present contact through the overlap of their pressures, so

    F / k_w = f(d) - sum_i g_i / tau_i  int exp(-(t - s) / tau_i) f(d(s)) overlap(|x(t) - x(s)|) ds

It holds for sliding at any speed, for holding still (there it is the usual relaxation), for turns and for neighbouring lines.
"""

from __future__ import annotations

import numpy as np

from palpate_assessment.contact import ReferenceContact
from palpate_models.frames import Array

_SLICE = 4
"""States gathered into one slice of the path: 40 ms at 100 Hz, over which the wall hardly relaxes."""


class PathMemory:
    """The history of the indentation, and the force that the wall has lost by it."""

    def __init__(self, contact: ReferenceContact) -> None:
        self._contact = contact
        self._g = np.array(contact.material.prony_g)
        self._tau = np.array(contact.material.prony_tau_s)
        self._slices = np.zeros((1024, 5))
        """Time [s], impulse f(d) dt [m^3 s], position [m] of each slice."""
        self._count = 0
        self._open: list[tuple[float, float, float, float, float, float]] = []

    def add(self, time: float, dt: float, position: Array, depth: float) -> None:
        """Notes that the indenter was at `position` [m], shape (3,), at `depth` [m], for `dt` seconds up to `time` [s]."""
        self._open.append((time - 0.5 * dt, dt, max(depth, 0.0), *position.tolist()))

    def lost(self, time: float, position: Array) -> float:
        """Force over k_w [m^3] that memory takes from an indentation at `position` [m], shape (3,), at `time` [s]."""
        self._slice()
        slices = self._slices[: self._count]
        overlap = self._contact.overlap(np.linalg.norm(slices[:, 2:] - position, axis=1))
        age = np.maximum(time - slices[:, 0], 0.0)
        kernel = (self._g / self._tau) @ np.exp(-age / self._tau[:, None])
        return float(kernel @ (slices[:, 1] * overlap))

    def _slice(self) -> None:
        """Gathers what was added since into slices; those without contact leave nothing."""
        if not self._open:
            return
        block = np.array(self._open)
        self._open.clear()
        first = np.arange(0, len(block), _SLICE)
        total = np.add.reduceat(block, first)
        mean = total / np.diff(first, append=len(block))[:, None]
        impulse = self._contact.force(mean[:, 2]) * total[:, 1]
        new = np.column_stack((mean[:, 0], impulse, mean[:, 3:]))[mean[:, 2] > 0.0]
        end = self._count + len(new)
        if end > len(self._slices):
            self._slices = np.concatenate([self._slices, np.zeros((max(end, 1024), 5))])
        self._slices[self._count : end] = new
        self._count = end
