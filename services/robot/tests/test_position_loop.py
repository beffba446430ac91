"""Position commands in simulation: the loop on either engine, and what the driver refuses."""

import numpy as np
import pytest

from palpate_bus.messages import NS
from palpate_bus.messages.codes import DriverMode, HoldCause
from palpate_models.robot.lbr import ARM, HOME
from palpate_models.scenario.schema import Robot
from palpate_robot.backends.dart.plant import DartPlant
from palpate_robot.backends.mujoco.plant import MujocoPlant
from palpate_robot.driver import Command, Driver
from palpate_robot.plant import DT
from palpate_robot.position_loop import TUNING, PositionLoop

MS = 1_000_000
STILL = np.zeros(7)


class Arm:
    """A plant that follows positions."""

    def __init__(self, plant: type) -> None:
        self.plant = plant(Robot())
        self.loop = PositionLoop(ARM, self.plant.q)

    def step(self, command: np.ndarray | None, force_W: np.ndarray | None = None, age: int = 0) -> np.ndarray:
        gravity = self.plant.gravity_torque()
        torque = self.loop.torque(command, self.plant.q, self.plant.v, gravity, age)
        assert (np.abs(torque + gravity - self.loop.damping * self.plant.v) <= ARM.torque_nm + 1e-9).all()
        self.plant.step(gravity + torque, force_W, np.zeros(3), self.loop.damping)
        return self.plant.q - HOME


@pytest.mark.parametrize("plant", [DartPlant, MujocoPlant])
def test_a_ramp_is_followed_after_the_latency(plant: type) -> None:
    arm, speed = Arm(plant), 0.3
    for k in range(500):
        moved = arm.step(HOME + speed * k * DT)
    np.testing.assert_allclose(moved, speed * (499 * DT - TUNING.latency_ns / NS), atol=1.5e-3)
    assert np.abs(arm.plant.v - speed).max() < 0.02


def test_late_and_missed_commands_do_not_jerk_it() -> None:
    """By the wall clock commands come late, in bursts, and not all of them."""
    arm, speed, ages = Arm(DartPlant), 0.3, np.random.default_rng(1)
    newest = 0
    for k in range(500):
        if k - newest > ages.integers(1, 12):
            newest = k
        arm.step(HOME + speed * newest * DT, age=(k - newest) * MS)
        if k > 200:
            assert np.abs(arm.plant.v - speed).max() < 0.02


@pytest.mark.parametrize("plant", [DartPlant, MujocoPlant])
def test_a_load_hardly_moves_it(plant: type) -> None:
    arm = Arm(plant)
    for _ in range(400):
        moved = arm.step(HOME, np.array((0.0, 0.0, 15.0)))
    assert 1e-5 < np.abs(moved).max() < 1e-3


def test_without_commands_it_stops_within_its_acceleration() -> None:
    arm = Arm(DartPlant)
    for k in range(300):
        before = arm.step(HOME + 0.5 * k * DT)
    for _ in range(300):
        after = arm.step(None)
    assert np.abs(arm.plant.v).max() < 2e-3
    braking = 0.5**2 / (2 * TUNING.acceleration_factor * ARM.acceleration_radps2)
    np.testing.assert_allclose(after - before, braking, atol=0.01)


def test_the_largest_jump_that_the_driver_takes_is_followed_within_the_limits() -> None:
    arm, jump = Arm(DartPlant), 0.02
    for _ in range(400):
        moved = arm.step(HOME + jump)
        assert (np.abs(arm.plant.v) <= 1.05 * ARM.velocity_radps).all()
        assert (moved < 1.5 * jump).all()
    np.testing.assert_allclose(moved, jump, atol=1e-3)


@pytest.mark.parametrize(
    ("wanted", "cause"),
    [
        (HOME + 0.5, HoldCause.INVALID_COMMAND),
        (np.where(np.arange(7) == 2, np.nan, HOME), HoldCause.INVALID_COMMAND),
        (np.where(np.arange(7) == 2, 4.0, HOME), HoldCause.POSITION_LIMIT),
        (np.zeros(0), HoldCause.INVALID_COMMAND),
    ],
)
def test_the_driver_refuses_positions_that_cannot_be(wanted: np.ndarray, cause: HoldCause) -> None:
    driver = Driver(ARM, 40.0, positions=True)
    update = {"q": HOME, "v": STILL, "gravity": STILL, "force": 0.0, "lost": False}
    np.testing.assert_array_equal(driver.update(MS, command=Command(HOME + 0.01, MS, 50 * MS), **update), HOME + 0.01)
    driver.update(2 * MS, command=Command(wanted, 2 * MS, 50 * MS), **update)
    assert (driver.mode, driver.cause) == (DriverMode.SAFE_HOLD, cause)
