"""Our scan patterns: lines along y_A (foot to head), side by side in x_A from the patient's right to the left.

Along such a line the wall curves least, so the tool turns least while it is in contact.
"""

from __future__ import annotations

import numpy as np

from palpate_models.frames import Array
from palpate_models.patterns.scan import Scan, Surface
from palpate_models.scenario import Exam


def lines(exam: Exam, surface: Surface) -> Scan:
    """Lines there and back, every second one first; the tool lifts at their ends, so that each has a touch and a tare of its own.

    Skin that was pressed takes a while to come back, and a touch beside it would find it too deep: what lies between two lines is
    pressed a minute after them.
    """
    del surface
    along = _upward(exam)
    return Scan(_there_and_back(along[::2] + along[1::2]))


def raster(exam: Exam, surface: Surface) -> Scan:
    """All lines from the feet to the head; the tool lifts at their ends."""
    del surface
    return Scan(_upward(exam))


def snake(exam: Exam, surface: Surface) -> Scan:
    """Lines there and back, joined in contact by arcs."""
    del surface
    return Scan(_there_and_back(_upward(exam)), joined=True)


def search(exam: Exam, surface: Surface) -> Scan:
    """The places that a search may ask for."""
    del surface
    return Scan(_there_and_back(_upward(exam)))


def stations(centre: float, length: float, spacing: float) -> Array:
    """Evenly spread coordinates [m] over `length` about `centre`, both ends included, at most `spacing` apart."""
    count = int(np.ceil(length / spacing - 1e-9)) + 1
    return np.linspace(centre - length / 2, centre + length / 2, count)


def lattice(exam: Exam) -> tuple[Array, Array]:
    """Stations of the region in A: x of the lines, y on a line [m]."""
    (cx, cy), (width, height) = exam.centre_m, exam.region_m
    return stations(cx, width, exam.spacing_m), stations(cy, height, exam.spacing_m)


def _upward(exam: Exam) -> list[Array]:
    x, y = lattice(exam)
    return list(np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1))


def _there_and_back(along: list[Array]) -> list[Array]:
    return [line[::-1] if k % 2 else line for k, line in enumerate(along)]
