"""Disturbances of the assessment: what is not told to it costs it its band."""

from __future__ import annotations

import numpy as np

from palpate_validation.disturbances import ROWS, Disturbance, examined, line


def row(name: str) -> Disturbance:
    (found,) = [row for row in ROWS if row.name == name]
    return found


def test_an_offset_that_nobody_knows_of_costs_the_band() -> None:
    plain, off = (np.mean([examined(row(name), seed, 0.1)[1] for seed in (3, 4)]) for name in ("no errors", "depth off by 1 mm"))
    assert plain > 0.75
    assert off < plain - 0.1


def test_a_line_of_the_table_counts_patients() -> None:
    assert line(row("no errors"), range(3, 5), 0.1).startswith("| no errors | 0 of 2 (0–66 %) |")
