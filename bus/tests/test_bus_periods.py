"""Other periods of roles, for experiments."""

from importlib import resources

import pytest

from palpate_bus.contract import parse, with_periods

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
