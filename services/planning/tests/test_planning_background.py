"""Tasks of the background worker: used at their simulated time; in lockstep waited for, on a wall clock not."""

from __future__ import annotations

from threading import Event

import pytest

from palpate_planning.free_motion import BackgroundTask


def test_in_lockstep_the_result_is_due_at_its_time_whether_it_is_there_or_not() -> None:
    go = Event()
    task = BackgroundTask(1000, 50, lambda: go.wait(10) and 7)
    assert not task.due(1049)
    assert task.due(1050)
    go.set()
    assert task.result() == 7


def test_on_a_wall_clock_an_unfinished_task_is_not_due() -> None:
    go = Event()
    task = BackgroundTask(1000, 50, lambda: go.wait(10) and 7, lockstep=False)
    assert not task.due(5000)
    go.set()
    assert task.result() == 7
    assert not task.due(1049)
    assert task.due(1050)


def test_what_the_work_raises_is_raised_again() -> None:
    def fail() -> int:
        raise KeyError("why")

    with pytest.raises(KeyError, match="why"):
        BackgroundTask(0, 0, fail).result()
