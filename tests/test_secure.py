"""A whole short examination over a secure router: the same run, and no service does what its row does not say."""

from pathlib import Path

import pytest
from examination import palpate_run

TINY = ("exam.region_m=[0.03, 0.03]", "exam.centre_m=[-0.055, -0.055]", "phantom.edge_m=0.02", "camera.frames=2")


@pytest.mark.slow
def test_a_secure_examination_completes_with_the_same_run_hash(tmp_path: Path) -> None:
    secure = palpate_run("clean", tmp_path / "secure", "--secure", settings=TINY)
    assert secure.status == 0, secure.output
    composed = palpate_run("clean", tmp_path / "composed", "--composed", "--record", "none", settings=TINY)
    assert secure.report["run_hash"] == composed.report["run_hash"]


def test_secure_options_that_do_not_go_together_are_refused(tmp_path: Path) -> None:
    finished = palpate_run("clean", tmp_path, "--composed", "--secure")
    assert finished.status == 2
    assert "--secure" in finished.output
    finished = palpate_run("clean", tmp_path, "--secure", "--keys", str(tmp_path / "none"))
    assert finished.status == 2
    assert "ca.pem" in finished.output
