"""docs/reference/results.md has every column of samples.csv."""

from __future__ import annotations

from pathlib import Path

from palpate.report.results import sample_columns

REFERENCE = Path(__file__).parents[2] / "docs" / "reference"


def test_every_column_of_the_samples_is_documented() -> None:
    page = (REFERENCE / "results.md").read_text(encoding="utf-8")

    class Empty:
        """Samples without any."""

    import numpy as np

    samples = Empty()
    for name in ("time", "depth", "force", "speed", "time_in_contact", "depth_uncertainty", "stroke"):
        setattr(samples, name, np.empty(0))
    samples.position = samples.normal = np.empty((0, 3))
    for column in (*sample_columns(samples), "force_limited", "run"):
        assert f"| `{column}` |" in page, column
