"""Delays on the bus: the wrapper, the contact on either side of its margin, the theory, and the report."""

from __future__ import annotations

import json

import numpy as np
import pytest
from typer.testing import CliRunner

from palpate.command_line import EXIT_BAD_INPUT
from palpate_bus.messages.stamps import NS
from palpate_validation import stability
from palpate_validation.check import Check, PageSection
from palpate_validation.contact_rig import CONTACT_PATH, CONTROL_PATH, EVENTS, Delays, press
from palpate_validation.delays import BusDelay, DelayedInbox
from palpate_validation.loop_theory import linearise
from palpate_validation.report import failures, number, write, write_page

MS = NS // 1000


class Bus:
    """An inbox that brings one message a millisecond: its own time."""

    def __init__(self) -> None:
        self.t = 0

    def latest(self, topic: str) -> object:
        return self.t

    def new(self, topic: str) -> list[object]:
        return [self.t]

    def stamp(self, topic: str) -> int:
        return self.t

    def lost(self, role: str) -> bool:
        return role == "gone"


def received(delay: BusDelay, steps: int = 60) -> list[list[object]]:
    inbox, bus = DelayedInbox({"late": delay}), Bus()
    out = []
    for k in range(steps):
        bus.t = k * MS
        inbox.advance(bus.t, bus, {})
        out.append(list(inbox.new("late")))
        assert inbox.latest("on time") == bus.t
    assert inbox.lost("gone")
    return out


def test_a_constant_delay_shifts_messages() -> None:
    out = received(BusDelay(0.003))
    assert out[:3] == [[], [], []]
    assert out[3:] == [[k * MS] for k in range(57)]


def test_jitter_keeps_order_and_loses_nothing() -> None:
    out = received(BusDelay(0.001, 0.006, seed=4))
    flat = [message for step in out for message in step]
    assert flat == [k * MS for k in range(len(flat))]
    assert len(flat) >= 60 - 8
    ages = [k * MS - step[-1] for k, step in enumerate(out) if step]
    assert min(ages) >= 1 * MS
    assert len(set(ages)) > 2
    assert received(BusDelay(0.001, 0.006, seed=4)) == out


def test_a_late_message_keeps_its_stamp() -> None:
    inbox, bus = DelayedInbox({"late": BusDelay(0.002)}), Bus()
    assert inbox.latest("late") is None
    for k in range(5):
        bus.t = k * MS
        inbox.advance(bus.t, bus, {"scripted": "now"} if k == 4 else {})
    assert inbox.stamp("late") == 2 * MS
    assert inbox.latest("late") == 2 * MS
    assert list(inbox.new("scripted")) == ["now"]


def test_a_negative_delay_is_refused() -> None:
    with pytest.raises(ValueError, match="not be negative"):
        BusDelay(-0.001)


def test_contact_on_either_side_of_its_margin() -> None:
    """The margin is 8 to 10 ms a message; theory and measurement agree that 4 is inside and 14 outside."""
    loop = linearise(1.0, stability.STIFFNESS_NPM)
    assert loop.stable(0, 0)
    assert loop.stable(4, 4)
    assert not loop.stable(14, 14)
    assert 7 <= loop.margin_ms(CONTROL_PATH) <= 12
    assert press(1.0, stability.STIFFNESS_NPM, Delays(EVENTS, 0.004)).stable
    assert not press(1.0, stability.STIFFNESS_NPM, Delays(EVENTS, 0.014)).stable


def test_the_path_that_hardware_does_not_have_is_not_the_weak_one() -> None:
    assert press(1.0, stability.STIFFNESS_NPM, Delays(CONTACT_PATH, 0.014)).stable


def test_a_soft_controller_bears_more_delay() -> None:
    assert linearise(1.0, 1000.0).margin_ms(CONTROL_PATH) >= linearise(1.0, 5000.0).margin_ms(CONTROL_PATH)


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_stability_under_delay_and_jitter() -> None:
    missed = [f"{c.name}: {c.measured}, want {c.bound} ({c.against})" for c in stability.section().checks if c.passed is False]
    assert not missed


def a_section() -> PageSection:
    checks = (Check("good", 1.0, "N", high=2.0, against="theory"), Check("bad", 3.0, high=2.0), Check("told", 5.0))
    return PageSection(
        "name",
        "Title",
        "Text.",
        checks,
        lambda f: f.subplots().plot([1, 2]),
        data={"x": np.array((1.0, np.nan)), "n": np.int64(3)},
    )


def test_report_files(tmp_path) -> None:
    section = a_section()
    write([section], tmp_path / "out")
    facts = json.loads((tmp_path / "out" / "validate.json").read_text())
    assert facts["name"]["data"] == {"x": [1.0, None], "n": 3}
    assert [c["passed"] for c in facts["name"]["checks"]] == [True, False, None]
    assert (tmp_path / "out" / "name.png").read_bytes()[:4] == b"\x89PNG"
    assert [c.name for c in failures([section])] == ["bad"]
    write_page([section], tmp_path / "page.md", tmp_path / "images" / "validation")
    page = (tmp_path / "page.md").read_text()
    assert "**missed**" in page
    assert "(images/validation/name.png)" in page


def test_numbers_are_short() -> None:
    assert [number(x) for x in (0, 1.23456, 1234.5, 1.5e-9, -0.31195)] == ["0", "1.23", "1234", "1.5e-09", "-0.312"]


def test_the_command(tmp_path, monkeypatch) -> None:
    from palpate_validation import cli

    monkeypatch.setattr(cli, "run_section", lambda name: a_section())
    runner = CliRunner()
    result = runner.invoke(cli.app, ["--only", "hertz", "--out", str(tmp_path)])
    assert result.exit_code == cli.EXIT_MISSED
    assert "FAIL" in result.output
    assert runner.invoke(cli.app, ["--only", "nonsense"]).exit_code == EXIT_BAD_INPUT
