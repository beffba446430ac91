"""A search policy: press the most probable place of a lump that has not been pressed yet."""

import numpy as np


def next_press(posterior, budget):
    """Return place [m], xy in the abdomen frame, and depth [m] of the next press."""
    places, probability = posterior.task.places, posterior.by_place.copy()
    for press in posterior.presses:
        probability[np.linalg.norm(places - press.xy, axis=1) < 0.015] = 0.0
    return places[np.argmax(probability)], posterior.task.depth
