"""The elastic tissue on its own timer: a short examination in wall-clock time."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from examination import SHORT, palpate_run

ELASTIC = (*SHORT, "services.tissue=elastic")


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_an_examination_of_the_elastic_tissue_completes_with_findings(tmp_path: Path) -> None:
    """Needs a machine of its own, as docs/wall-clock.md says: it fails where others take the processors.

    The compliance is computed beforehand, as its README asks: on a busy machine that takes longer than a run waits.
    """
    words = [sys.executable, "-m", "palpate_tissue.backends.elastic.prepare", "clean"]
    subprocess.run([*words, *(word for setting in ELASTIC for word in ("--set", setting))], check=True, timeout=600)
    finished = palpate_run("clean", tmp_path, "--wallclock", "--record", "none", settings=ELASTIC, timeout=300)
    assert finished.status == 0, finished.output
    report = finished.report
    assert report["samples"] > 50
    assert report["findings"], finished.output
    assert 1 < report["max_force_N"] < 20
