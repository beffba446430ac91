"""The set-point: back and forth without loss, and nothing that the contract does not allow."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from palpate_bus.contract import contract
from palpate_bus.messages import Quaternion
from palpate_bus.messages.stamps import nanoseconds
from palpate_bus.setpoint import TOPIC, ControlMode, Setpoint


def setpoint(**changes: Any) -> Setpoint:
    rng = np.random.default_rng(1)
    fields: dict[str, Any] = {
        "stamp": 1_234_567_890,
        "mode": ControlMode.CARTESIAN,
        "R_WD": Rotation.from_rotvec((0.3, -2.0, 0.9)).as_matrix(),
        "p_WD": rng.uniform(-1, 1, 3),
        "V_WD": rng.uniform(-1, 1, 6),
        "F_W": rng.uniform(-10, 10, 6),
        "stiffness": rng.uniform(0, 5000, 6),
        "damping_ratio": rng.uniform(0, 1, 6),
        "q": rng.uniform(-2, 2, 7),
        "qd": rng.uniform(-1, 1, 7),
        "joint_stiffness": rng.uniform(0, 800, 7),
    }
    return Setpoint(**{**fields, **changes})


def test_a_set_point_survives_its_message() -> None:
    before = setpoint()
    message = before.message()
    after = Setpoint.from_message(message)
    assert (after.stamp, after.mode) == (before.stamp, before.mode)
    for name in ("R_WD", "p_WD", "V_WD", "F_W", "stiffness", "damping_ratio", "q", "qd", "joint_stiffness"):
        np.testing.assert_allclose(getattr(after, name), getattr(before, name), atol=1e-14, err_msg=name)
    assert nanoseconds(message.valid_for) == contract().topics[TOPIC].expiry


@pytest.mark.parametrize("path", sorted(contract().topics[TOPIC].ranges))
@pytest.mark.parametrize("wrong", ["low", "high", "nan"])
def test_each_range_of_the_contract_is_kept(path: str, wrong: str) -> None:
    message = setpoint().message()
    least, most = contract().topics[TOPIC].ranges[path]
    value = {"low": least - 1.0, "high": most + 1.0, "nan": float("nan")}[wrong]
    *parents, last = path.split(".")
    owner = message
    for name in parents:
        owner = getattr(owner, name)
    field = getattr(owner, last)
    if isinstance(field, np.ndarray):
        changed = field.copy()
        changed[-1] = value
        setattr(owner, last, changed)
    else:
        field.z = value
    with pytest.raises(ValueError, match=path.replace(".", r"\.")):
        Setpoint.from_message(message)


def test_a_mode_that_is_none_and_a_quaternion_that_is_no_rotation_are_refused() -> None:
    message = setpoint().message()
    message.mode = 7
    with pytest.raises(ValueError, match="mode = 7"):
        Setpoint.from_message(message)
    message = setpoint().message()
    message.pose.orientation = Quaternion(0.0, 0.0, 0.0, 1.2)
    with pytest.raises(ValueError, match="norm"):
        Setpoint.from_message(message)
