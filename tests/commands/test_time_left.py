"""The bar of what takes long."""

from __future__ import annotations

import pytest
from rich.console import Console

from palpate.time_left import TimeLeft


def test_the_bar_follows_what_it_hears() -> None:
    with TimeLeft("playing", 10.0, 30.0) as bar:
        bar.reach(15.0)
        list(bar.get_renderables())
        assert bar.tasks[0].percentage == pytest.approx(25.0)


def test_nothing_is_drawn_where_there_is_no_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    assert not Console(stderr=True).is_terminal
    with TimeLeft("playing", 0.0, 1.0) as bar:
        bar.reach(1.0)
    assert capsys.readouterr().err == ""
