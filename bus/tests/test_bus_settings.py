"""The settings object: what it reads it writes, what is wrong it refuses by name, and its page is current."""

from pathlib import Path

import pytest

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
