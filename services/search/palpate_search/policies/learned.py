"""Policy learned by reinforcement: a small convolutional network over the places.

`python -m research.search.learn` trains it by proximal policy optimisation (Schulman et al. 2017) and writes `ppo.npz`. Inference
is three convolutions in numpy, for a region of any size.
"""

from functools import cache
from importlib.resources import as_file, files

import numpy as np

from palpate_models.numerics.frames import Array
from palpate_search.posterior import Budget, Posterior, maps

WEIGHTS = "ppo.npz"


@cache
def _weights() -> tuple[tuple[Array, Array], ...]:
    """Return kernel (out, in, 3, 3) or (out, in, 1, 1) and bias (out,) of each layer."""
    with as_file(files(__package__) / WEIGHTS) as file, np.load(file) as saved:
        return tuple((saved[f"kernel{k}"], saved[f"bias{k}"]) for k in range(len(saved.files) // 2))


def convolve(layers: Array, kernel: Array, bias: Array) -> Array:
    """Return a zero-padded convolution: (in, nx, ny) to (out, nx, ny)."""
    width = kernel.shape[-1] // 2
    padded = np.pad(layers, ((0, 0), (width, width), (width, width)))
    windows = np.lib.stride_tricks.sliding_window_view(padded, kernel.shape[2:], axis=(1, 2))
    return np.asarray(np.tensordot(kernel, windows, axes=((1, 2, 3), (0, 3, 4))) + bias[:, None, None])


def scores(posterior: Posterior) -> Array:
    """Return logits of presses with nominal and greatest depth at each place, shape (2, p)."""
    layers = maps(posterior)
    *hidden, last = _weights()
    for kernel, bias in hidden:
        layers = np.tanh(convolve(layers, kernel, bias))
    return convolve(layers, *last).reshape(2, -1)


def ppo(posterior: Posterior, budget: Budget) -> tuple[Array, float]:
    """Return the press with the greatest score."""
    task = posterior.task
    depth, place = np.divmod(int(np.argmax(np.where(posterior.open, scores(posterior), -np.inf))), len(task.places))
    return task.places[place], (task.depth, task.deepest)[depth]
