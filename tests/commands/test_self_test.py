"""What a machine can keep by the wall clock: measured, and kept to."""

from __future__ import annotations

import pytest
import typer
from toy_runs import run_toys

from palpate.console import EXIT_BAD_INPUT
from palpate.run import examine
from palpate.run.self_test import RATES, TimingResult, measure
from palpate_bus.messages.stamps import NS
from palpate_models.scenario.load import load_scenario


@pytest.mark.parametrize(
    ("ticks", "late_ms", "rate"),
    [
        (1.0, 0.3, 1.0),
        (0.999, 0.3, 0.5),
        (1.0, 15.0, 0.5),
        (0.3, 1.0, 0.25),
        (0.5, 90.0, 0.1),
        (0.05, 1.0, None),
        (1.0, 500.0, None),
    ],
)
def test_the_greatest_rate_that_was_kept_is_chosen(ticks: float, late_ms: float, rate: float | None) -> None:
    assert TimingResult(ticks, late_ms).rate == rate


def test_the_measurement_is_of_this_machine() -> None:
    kept = measure()
    assert 0.0 < kept.ticks <= 1.0
    assert kept.late_ms > 0.0


def told(monkeypatch: pytest.MonkeyPatch, kept: TimingResult, tissue: str = "winkler") -> float:
    monkeypatch.setattr(examine, "measure", lambda: kept)
    scenario = load_scenario("clean", [f"services.tissue={tissue}"])
    return examine._rate(scenario)


def test_a_run_says_what_rate_it_takes_or_why_it_does_not_begin(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.delenv("PALPATE_RATE", raising=False)
    assert told(monkeypatch, TimingResult(1.0, 1.0)) == 1.0
    assert capsys.readouterr().err == ""
    assert told(monkeypatch, TimingResult(0.4, 12.0)) == 0.25
    assert "keeps 0.25 of real time now: in a second three processes woke for 40 % of their ticks" in capsys.readouterr().err
    for kept, tissue, why in (
        (TimingResult(0.01, 900.0), "winkler", "cannot keep 0.1 of real time"),
        (TimingResult(0.4, 1.0), "none", "hardware"),
    ):
        with pytest.raises(typer.Exit) as refused:
            told(monkeypatch, kept, tissue)
        assert refused.value.exit_code == EXIT_BAD_INPUT
        assert why in capsys.readouterr().err
    monkeypatch.setenv("PALPATE_RATE", "0.5")
    assert told(monkeypatch, TimingResult(1.0, 1.0)) == RATES[1]


def test_time_goes_as_slowly_as_was_asked_for() -> None:
    outcome = run_toys(environment={"PALPATE_RATE": "0.25"}, wallclock=True)
    assert outcome.failure is None
    assert outcome.last_tick == pytest.approx(2 * NS, abs=0.2 * NS)
    assert outcome.wall_time_s > 0.9 * 2 / 0.25
