"""The rest of the gate (test_gate.py): a healthy patient, and a service killed in contact."""

from pathlib import Path

from examination import SHORT, assert_held_and_no_harder, kill_in_contact, palpate_run


def test_healthy_has_no_finding(tmp_path: Path) -> None:
    settings = (*SHORT, "camera.frames=4", "phantom.edge_m=0.01", "phantom.lesions=[]")
    finished = palpate_run("clean", tmp_path, "--composed", "--record", "none", settings=settings)
    assert finished.status == 0, finished.output
    assert finished.report["samples"] > 30
    assert finished.report["findings"] == []
    assert finished.report["scores"]["false_findings"] == 0


def test_a_killed_service_ends_the_run_by_name_and_the_force_does_not_rise(tmp_path: Path) -> None:
    killed = kill_in_contact("control", tmp_path)
    print(f"named {killed.named_after_s:.1f} s after it was killed")
    assert killed.named_after_s < 20.0, killed.lines  # two seconds, on a machine that has the time: test_losses.py
    assert_held_and_no_harder(killed)
