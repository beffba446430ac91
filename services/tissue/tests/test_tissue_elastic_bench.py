"""The size sweep measures both tiers, and says why one cannot."""

from __future__ import annotations

import pytest

from palpate_benchmarks import elastic as bench


@pytest.mark.parametrize("tier", ["surface", "elastic"])
def test_a_size_is_measured_in_contact(tier: str) -> None:
    figures = bench.measure_size(700, tier, steps=60)
    assert 500 < figures["vertices"] < 900
    assert figures["contacts"] > 3
    assert figures["step_us_mean"] > 0
    assert figures["substeps"] == 1


def test_a_size_that_is_too_large_is_refused_with_a_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("palpate_tissue.backends.elastic.compliance.MOST_VERTICES", 500)
    assert "at most 500" in bench.measure_size(700, "elastic", steps=10)["refused"]
