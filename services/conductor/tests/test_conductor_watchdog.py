"""Who blocks whom."""

from palpate_conductor.outcome import in_words
from palpate_conductor.watchdog import RunWatchdog

PRODUCERS = {"joint_states": "robot", "control/joint_torque": "control", "sim/contact_wrench": "tissue", "exam/state": "planning"}
ROLES = ("robot", "control", "tissue", "planning", "assessment")


def watchdog() -> RunWatchdog:
    return RunWatchdog((*ROLES, "dashboard"), PRODUCERS)


def test_the_one_that_waits_for_nobody_is_the_culprit() -> None:
    w = watchdog()
    w.report("control", 5_000_000, "joint_states")
    w.report("robot", 5_000_000, "sim/contact_wrench")
    w.report("tissue", 4_000_000, "")
    role, sentence = w.culprit(ROLES)
    assert role == "tissue"
    assert "control (for joint_states)" in sentence
    assert "robot (for sim/contact_wrench)" in sentence


def test_a_circle_is_named_as_one() -> None:
    w = watchdog()
    w.report("control", 1, "joint_states")
    w.report("robot", 1, "control/joint_torque")
    assert "circle of waiting" in w.culprit(ROLES)[1]


def test_waiting_for_a_grant_is_waiting_for_nobody() -> None:
    w = watchdog()
    w.report("robot", 1, "grant")
    assert "nobody waits for it" in w.culprit(ROLES)[1]


def test_only_a_finished_tick_counts_as_movement() -> None:
    w = watchdog()
    w.report("robot", 1_000_000, "")
    before = w.progress["robot"].moved
    w.report("robot", 1_000_000, "control/joint_torque")
    assert w.progress["robot"].moved == before
    w.report("nobody", 5, "")


def test_who_is_not_asked_about_blocks_nobody() -> None:
    w = watchdog()
    for progress in w.progress.values():
        progress.moved -= 100.0
    for role in ROLES:
        w.report(role, 1_000_000, "")
    assert w.longest_stall((*ROLES, "dashboard")) > 99.0
    assert w.longest_stall(ROLES) < 50.0
    assert w.longest_stall(()) < 1.0
    assert w.culprit(ROLES)[0] != "dashboard"


def test_when_all_wait_for_a_grant_none_of_them_blocks() -> None:
    w = watchdog()
    for role in ROLES:
        w.report(role, 1_000_000, "grant")
    assert w.culprit(ROLES)[0] == "conductor"


def test_when_none_is_heard_it_is_the_transport() -> None:
    w = watchdog()
    for progress in w.progress.values():
        progress.reported -= 100.0
    assert w.silent_for() > 99.0
    w.report("robot", 1_000_000, "")
    assert w.silent_for() < 50.0


def test_a_silence_of_all_is_told_when_a_run_has_failed() -> None:
    w = watchdog()
    w.progress["robot"].reported -= 2.0
    w.note_silence()
    assert w.interruption == "", "one role was silent, the others were heard"
    for progress in w.progress.values():
        progress.reported -= 2.0
    w.note_silence()
    w.report("robot", 1_000_000, "")
    assert "for 2.0 s nothing was heard of any service" in w.interruption


def test_what_nobody_expected_is_a_failure_too() -> None:
    assert in_words(ValueError("odd"), 0) == "the conductor failed: ValueError: odd"
    assert in_words(KeyboardInterrupt(), 2_500_000_000) == "interrupted at 2.500 s"
