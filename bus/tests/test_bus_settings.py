"""Settings of a run: environment, wrong values, periods of roles."""

from importlib import resources
from pathlib import Path

import pytest

from palpate_bus.contract import parse, with_periods
from palpate_bus.settings import BusConfigError, Settings

SETTINGS = {
    "PALPATE_LISTEN": "tcp/a:1, tcp/b:2",
    "PALPATE_ROUTER": "",
    "PALPATE_RUNTIME": "wallclock",
    "PALPATE_RECORD": "full",
    "PALPATE_PERIODS": "control=5,planning=20",
    "PALPATE_COMPOSE": "a.yml:b.yml",
    "PALPATE_OUT": "/results",
    "ROS_DOMAIN_ID": "7",
}


def test_environment_is_read_with_types_and_written_back() -> None:
    settings = Settings.read(SETTINGS)
    assert settings.listen == ("tcp/a:1", "tcp/b:2")
    assert settings.router is None
    assert settings.record == "full"
    assert settings.domain == 7
    assert settings.periods == {"control": 5, "planning": 20}
    assert settings.compose == (Path("a.yml"), Path("b.yml"))
    assert Settings.read(settings.to_env()) == settings


def test_process_reads_its_own_environment_and_a_child_gets_changes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PALPATE_ROUTER", "tcp/host:7447")
    child = Settings.read().replaced(runtime="wallclock", router=None)
    assert child.runtime == "wallclock"
    assert child.to_env()["PALPATE_ROUTER"] == ""  # undoes the inherited one
    assert Settings.read({}) == Settings.read({}).replaced()


@pytest.mark.parametrize(
    ("name", "value", "allowed"),
    [
        ("PALPATE_MODE", "star", "peer, client, router"),
        ("PALPATE_RUNTIME", "fast", "lockstep, wallclock"),
        ("PALPATE_RECORD", "maybe", "none, normal, full"),
        ("PALPATE_RECORD_FILE_MB", "0", "a whole number from 1"),
        *[("PALPATE_PERIODS", bad, "ROLE=MILLISECONDS") for bad in ("control", "control=0", "control=2.5", "control=5,")],
        ("ROS_DOMAIN_ID", "233", "0 to 232"),
    ],
)
def test_wrong_value_is_refused_with_what_is_allowed(
    name: str, value: str, allowed: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(name, value)
    for environment in (None, {name: value}):
        with pytest.raises(BusConfigError, match=f"{name} is '{value}'.*allowed: {allowed}"):
            Settings.read(environment)


def test_wrong_change_and_missing_setting_are_refused() -> None:
    with pytest.raises(BusConfigError, match="there is no setting speed"):
        Settings.read({}).replaced(speed=3)
    with pytest.raises(BusConfigError, match="PALPATE_RUNTIME is 'fast'"):
        Settings.read({}).replaced(runtime="fast")
    with pytest.raises(BusConfigError, match="PALPATE_OUT is not set; give it the run's folder"):
        Settings.read({}).required("out", "give it the run's folder")


TEXT = resources.files("palpate_bus.contract").joinpath("contract.yaml").read_text(encoding="utf-8")


def test_a_slower_role_sends_at_each_of_its_steps_and_nothing_else_changes() -> None:
    usual, slow = parse(TEXT), parse(with_periods(TEXT, {"control": 5}))
    assert slow.roles["control"].period_ms == 5
    assert slow.topics["control/joint_torque"].period_ms == 5
    others = {name: row for name, row in usual.topics.items() if row.producer != "control"}
    assert all(slow.topics[name] == row for name, row in others.items())
    assert parse(with_periods(TEXT, {"control": 1})) == usual


def test_a_role_that_is_none_is_named() -> None:
    with pytest.raises(ValueError, match="PALPATE_PERIODS: unknown role 'controller'"):
        with_periods(TEXT, {"controller": 5})
