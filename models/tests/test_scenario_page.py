"""The page of a scenario's fields."""

from __future__ import annotations

from palpate_models.scenario_page import page


def test_fields_bounds_and_defaults_of_nested_sections_are_there() -> None:
    rows = [line for line in page().splitlines() if line.startswith("| `")]
    assert any(row.startswith("| `depth_m` | `0.01` | a number at least 0.002, at most 0.02 |") for row in rows)
    assert "| `xyz_m` | `[0.56, 0.0, 0.93]` |" in page()  # that of the examination, not a pose's own
    assert "## `phantom.lesions[]`" in page()
