"""The polyline against numpy.interp."""

import numpy as np
from palpate_models.polyline import Polyline


def test_it_is_numpys_interpolation_to_the_bit() -> None:
    rng = np.random.default_rng(3)
    x, y = np.sort(rng.normal(size=40)), rng.normal(size=40)
    line = Polyline(x, y)
    places = np.concatenate((x, rng.uniform(x[0] - 1.0, x[-1] + 1.0, 1000)))
    assert [line.at(place) for place in places.tolist()] == np.interp(places, x, y).tolist()


def test_a_single_point_holds_everywhere() -> None:
    line = Polyline(np.array([1.0]), np.array([2.0]))
    assert [line.at(x) for x in (0.0, 1.0, 3.0)] == [2.0, 2.0, 2.0]
