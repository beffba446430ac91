"""The rate of real time that a machine keeps in wall-clock mode."""

import pytest
from toy_runs import run_toys

from palpate.run import examine
from palpate.run.self_test import RATES, TimingResult, measure
from palpate_bus.messages.stamps import NS
from palpate_errors import UserError
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
def test_the_greatest_kept_rate_is_chosen(ticks: float, late_ms: float, rate: float | None) -> None:
    assert TimingResult(ticks, late_ms).rate == rate


def test_the_measurement_is_of_this_machine() -> None:
    kept = measure(2)
    assert 0.0 < kept.ticks <= 1.0
    assert kept.late_ms > 0.0


def rate_of(monkeypatch: pytest.MonkeyPatch, kept: TimingResult, tissue: str = "winkler") -> float:
    monkeypatch.setattr(examine, "measure", lambda _: kept)
    return examine._rate(load_scenario("clean", [f"services.tissue={tissue}"]))


def test_a_run_reports_its_rate_or_why_it_does_not_begin(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.delenv("PALPATE_RATE", raising=False)
    assert rate_of(monkeypatch, TimingResult(1.0, 1.0)) == 1.0
    assert capsys.readouterr().err == ""
    assert rate_of(monkeypatch, TimingResult(0.4, 12.0)) == 0.25
    assert "keeps 0.25 of real time" in capsys.readouterr().err
    with pytest.raises(UserError, match=r"cannot keep 0\.1 of real time"):
        rate_of(monkeypatch, TimingResult(0.01, 900.0))
    with pytest.raises(UserError, match="hardware"):
        rate_of(monkeypatch, TimingResult(0.4, 1.0), "none")
    monkeypatch.setenv("PALPATE_RATE", "0.5")
    assert rate_of(monkeypatch, TimingResult(1.0, 1.0)) == RATES[1]


def test_time_runs_at_the_requested_rate() -> None:
    outcome = run_toys(environment={"PALPATE_RATE": "0.25"}, wallclock=True)
    assert outcome.failure is None
    assert outcome.last_tick == pytest.approx(2 * NS, abs=0.2 * NS)
    assert outcome.wall_time_s > 0.9 * 2 / 0.25
