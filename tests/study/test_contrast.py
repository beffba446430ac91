"""Lumps by how they feel."""

from __future__ import annotations

import pytest
import synthetic

from palpate.study.statistics.detection import by_contrast


def test_lumps_are_counted_in_the_class_of_what_they_feel_like() -> None:
    cases, lumps = [], []
    made = [
        (1.2, 0.02, False, 0.1),
        (1.4, 0.02, True, 0.9),
        (1.4, 0.01, False, 0.3),
        (0.5, 0.02, True, 0.8),
        (3.0, 0.01, True, 0.9),
    ]
    for number, (contrast, radius, found, score) in enumerate(made):
        cases.append(synthetic.case(number, "lumps", palpable=1, score=score))
        lumps.append(
            synthetic.lump(cases[-1]["case_id"], felt_contrast=contrast, felt_radius_m=radius, found=found, confidence=score)
        )
    cases += [synthetic.case(number, "healthy", score=0.2) for number in range(4)]
    tables = synthetic.tables(cases, [], lumps)
    rows = by_contrast(tables.variants[0], tables.bootstrap)
    assert {name: (row.found.value, row.found.n, row.found_wide.n) for name, row in rows.items()} == {
        "below 1.3": (0.0, 1, 1),
        "1.3 to 1.5": (0.5, 2, 1),
        "1.5 to 2": (None, 0, 0),
        "2 and more": (1.0, 2, 1),
    }
    areas = {name: None if row.auc is None else row.auc.value for name, row in rows.items()}
    assert areas["1.5 to 2"] is None
    assert areas["below 1.3"] == pytest.approx(0.0)
    assert areas["1.3 to 1.5"] == pytest.approx(1.0)
