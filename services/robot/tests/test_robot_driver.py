"""The driver's contract, tick by tick."""

import numpy as np
import pytest

from palpate_bus.contract import contract
from palpate_bus.messages import OperatorRequest, SupervisorState, header
from palpate_bus.messages.codes import DriverMode, HoldCause
from palpate_bus.testing import HandInbox
from palpate_models.robot import lbr
from palpate_models.robot.lbr import ARM
from palpate_robot.driver import TUNING, Command, Driver
from palpate_robot.stop_requests import StopRequests

MS = 1_000_000
STILL = np.zeros(7)
GRAVITY = np.array([0.0, -40.0, 0.0, 15.0, 0.0, 0.5, 0.0])
EMERGENCY = 40.0


def _command(t: int, torque: np.ndarray | None = None, valid_ms: float = 50) -> Command:
    return Command(np.full(7, 2.0) if torque is None else torque, t, t + int(valid_ms * MS))


def _update(driver: Driver, t: int, command: Command | None, **changes: object) -> np.ndarray:
    state = {"q": lbr.HOME, "v": STILL, "gravity": GRAVITY, "force": 0.0, "lost": False} | changes
    return driver.update(t, command=command, **state)


@pytest.fixture
def active() -> Driver:
    driver = Driver(ARM, EMERGENCY)
    _update(driver, MS, _command(0))
    assert driver.mode is DriverMode.ACTIVE
    return driver


def test_idle_until_the_first_valid_command() -> None:
    driver = Driver(ARM, EMERGENCY)
    assert not _update(driver, 0, None).any()
    assert not _update(driver, 5 * MS, _command(MS, valid_ms=0)).any()
    assert driver.mode is DriverMode.IDLE, "a command that is already expired is ignored"
    np.testing.assert_array_equal(_update(driver, 6 * MS, _command(5 * MS)), np.full(7, 2.0))
    assert driver.mode is DriverMode.ACTIVE


@pytest.mark.parametrize("valid_ms", [20, 3_600_000])
def test_obeys_to_the_last_valid_nanosecond_and_no_longer_than_the_contract_says(active: Driver, valid_ms: int) -> None:
    last, expiry = _command(10 * MS, valid_ms=valid_ms), contract().topics["control/joint_torque"].expiry
    assert expiry is not None
    expires = min(last.expires, 10 * MS + expiry)
    assert _update(active, expires, last).any()
    assert not _update(active, expires + 1, last).any()
    assert (active.mode, active.cause) == (DriverMode.SAFE_HOLD, HoldCause.COMMAND_EXPIRED)


@pytest.mark.parametrize(
    ("changes", "cause", "words"),
    [
        ({"lost": True}, HoldCause.COMMANDER_LOST, "control"),
        ({"force": 40.5}, HoldCause.FORCE_LIMIT, "40.5 N"),
        ({"force": float("nan")}, HoldCause.FORCE_LIMIT, "nan N"),
        ({"q": lbr.HOME + np.eye(7)[3] * -0.5}, HoldCause.POSITION_LIMIT, "lbr_A4"),
        ({"q": lbr.HOME * np.nan}, HoldCause.POSITION_LIMIT, "lbr_A1"),
        ({"v": np.eye(7)[5] * 3.2}, HoldCause.VELOCITY_LIMIT, "lbr_A6"),
        ({"v": np.eye(7)[1] * -1.8}, HoldCause.VELOCITY_LIMIT, "lbr_A2"),
    ],
)
def test_broken_limits_hold(active: Driver, changes: dict, cause: HoldCause, words: str) -> None:
    torque = _update(active, 2 * MS, _command(MS), **changes)
    assert not torque.any()
    assert (active.mode, active.cause) == (DriverMode.SAFE_HOLD, cause)
    assert words in active.reason


@pytest.mark.parametrize(
    ("torque", "cause", "words"),
    [
        (np.array([0, 0, np.nan, 0, 0, 0, 0.0]), HoldCause.INVALID_COMMAND, "lbr_A3"),
        (np.array([np.inf, 0, 0, 0, 0, 0, 0.0]), HoldCause.INVALID_COMMAND, "lbr_A1"),
        (np.zeros(6), HoldCause.INVALID_COMMAND, "(6,)"),
        (np.zeros((7, 1)), HoldCause.INVALID_COMMAND, "(7, 1)"),
        (np.array([0, 0, 0, 0, 0, 0, 40.1]), HoldCause.TORQUE_LIMIT, "lbr_A7"),
        (np.array([0, -140.0, 0, 0, 0, 0, 0]), HoldCause.TORQUE_LIMIT, "gravity"),
    ],
)
@pytest.mark.parametrize("first", [True, False])
def test_bad_commands_hold_and_are_counted(torque: np.ndarray, cause: HoldCause, words: str, first: bool) -> None:
    driver = Driver(ARM, EMERGENCY)
    if not first:
        _update(driver, MS, _command(0))
    assert not _update(driver, 2 * MS, _command(MS, torque)).any()
    assert (driver.mode, driver.cause, driver.rejected) == (DriverMode.SAFE_HOLD, cause, 1)
    assert words in driver.reason


def test_full_torque_in_room_left_by_gravity_is_obeyed(active: Driver) -> None:
    torque = lbr.TORQUE_LIMIT - GRAVITY
    reach = int(np.max(np.abs(torque - 2.0)) / TUNING.torque_rate_nm_per_ms) + 1
    for ms in range(1, reach + 1):
        obeyed = _update(active, ms * MS, _command(ms * MS, 2.0 + (torque - 2.0) * ms / reach))
    np.testing.assert_array_equal(obeyed, torque)


@pytest.mark.parametrize(("ahead_ms", "jump_nm"), [(488, 150.0), (3_600_000, 0.0)])
def test_a_stamp_that_is_ahead_allows_no_larger_jump_and_is_refused(active: Driver, ahead_ms: int, jump_nm: float) -> None:
    ahead = _command((2 + ahead_ms) * MS, 2.0 + jump_nm * np.eye(7)[1])
    assert not _update(active, 2 * MS, ahead).any()
    assert active.cause is HoldCause.INVALID_COMMAND


def test_a_jump_of_the_torque_holds(active: Driver) -> None:
    """A damaged message: every number in its range, and none that the controller can have meant."""
    for tick in range(1, 40):
        torque = np.full(7, 2.0) + np.eye(7)[3] * 0.9 * TUNING.torque_rate_nm_per_ms * tick
        assert _update(active, (tick + 1) * MS, _command(tick * MS, torque)).any()
    assert active.mode is DriverMode.ACTIVE
    assert not _update(active, 41 * MS, _command(40 * MS, torque - 2 * np.eye(7)[3] * torque)).any()
    assert (active.mode, active.cause, active.rejected) == (DriverMode.SAFE_HOLD, HoldCause.INVALID_COMMAND, 1)
    assert "lbr_A4" in active.reason


def test_the_first_command_after_a_release_is_judged_by_its_size(active: Driver) -> None:
    for torque, obeyed in ((TUNING.first_torque_nm, True), (1.1 * TUNING.first_torque_nm, False)):
        active.hold(2 * MS, HoldCause.STOP_REQUESTED, "operator")
        active.release(3 * MS)
        assert _update(active, 5 * MS, _command(4 * MS, np.full(7, torque))).any() == obeyed
    assert active.cause is HoldCause.INVALID_COMMAND


def test_a_controller_that_gives_up_says_why(active: Driver) -> None:
    last = Command(STILL, MS, MS, "joint_states are 21 ms old, limit 20 ms")
    assert not _update(active, 2 * MS, last).any()
    assert active.cause is HoldCause.COMMAND_EXPIRED
    assert last.problem in active.reason


def test_hold_is_latched_and_keeps_its_first_cause(active: Driver) -> None:
    _update(active, 2 * MS, _command(MS), force=50.0)
    for tick in range(3, 200):
        assert not _update(active, tick * MS, _command((tick - 1) * MS)).any()
    active.hold(200 * MS, HoldCause.SUPERVISOR, "late")
    assert active.cause is HoldCause.FORCE_LIMIT
    assert len(active.holds) == 1


def test_release_waits_for_a_command_sent_after_it(active: Driver) -> None:
    active.hold(2 * MS, HoldCause.STOP_REQUESTED, "operator")
    old = _command(2 * MS)
    active.release(3 * MS)
    assert (active.mode, active.cause, active.reason) == (DriverMode.IDLE, HoldCause.NONE, "")
    assert not _update(active, 3 * MS, old).any()
    assert active.mode is DriverMode.IDLE
    assert _update(active, 5 * MS, _command(4 * MS)).any()
    assert active.mode is DriverMode.ACTIVE


def test_a_release_undoes_no_stop_of_after_it_was_granted(active: Driver) -> None:
    requests, inbox = StopRequests(active), HandInbox()
    active.hold(2 * MS, HoldCause.SUPERVISOR, "41 N")
    inbox.events["operator/request"] = [OperatorRequest(header(5 * MS), OperatorRequest.STOP, "it hurts")]
    requests.apply(6 * MS, inbox)
    assert active.cause is HoldCause.STOP_REQUESTED, "the supervisor may not have received it, and releases others by itself"
    for releases, granted, held in ((1, 5 * MS, True), (1, 15 * MS, True), (2, 25 * MS, False)):
        inbox.events["supervisor/state"] = [SupervisorState(header(granted), 0, 0, "", releases, 0.0, 0.0, 0.0, 0, "", 0.0)]
        requests.apply(granted + 10 * MS, inbox)
        assert active.held is held


def test_release_does_not_help_while_the_limit_is_broken(active: Driver) -> None:
    far = lbr.HOME + np.eye(7)[3] * -0.5
    _update(active, 2 * MS, _command(MS), q=far)
    active.release(3 * MS)
    _update(active, 4 * MS, _command(3 * MS + 1), q=far)
    assert (active.mode, active.cause) == (DriverMode.SAFE_HOLD, HoldCause.POSITION_LIMIT)


@pytest.mark.parametrize("positions", [False, True])
def test_only_an_arm_of_positions_leaves_a_hold_with_too_much_force_and_not_while_it_rises(positions: bool) -> None:
    driver = Driver(ARM, EMERGENCY, positions=positions)
    for t, force in enumerate((0.0, 60.0, 60.0, 61.0, 50.0, 54.0)):
        if driver.held:
            driver.release(t * MS)
        _update(driver, (t + 1) * MS, _command(t * MS + 1, np.array(lbr.HOME)) if positions else None, force=force)
        assert driver.held == (force in (60.0, 54.0) and t != 2 if positions else force > EMERGENCY), t


def test_hold_damps_within_the_torque_limits(active: Driver) -> None:
    assert not active.damping(STILL, GRAVITY).any(), "an obeying driver adds no damping"
    active.hold(2 * MS, HoldCause.STOP_REQUESTED, "operator")
    for _ in range(TUNING.brake_ticks):
        np.testing.assert_array_equal(active.damping(STILL, GRAVITY), TUNING.brake_factor * ARM.hold_damping_nms)
    np.testing.assert_array_equal(active.damping(STILL, GRAVITY), ARM.hold_damping_nms)
    fast = np.array([1.7, -1.7, 1.7, 2.2, -2.4, 3.1, 3.1])
    total = np.abs(active.damping(fast, GRAVITY) * fast) + np.abs(GRAVITY)
    assert np.all(total <= lbr.TORQUE_LIMIT + 1e-9)


@pytest.mark.parametrize("torque", [np.full(7, 2.0), np.full(7, np.nan)])
def test_a_command_stamped_before_all_others_is_not_obeyed_unjudged(active: Driver, torque: np.ndarray) -> None:
    """`palpate faults` found it: a sender whose stamps are an hour behind was obeyed, without expiry and without limits."""
    assert not _update(active, 10 * MS, _command(-3600 * 1000 * MS, torque)).any()
    assert (active.mode, active.cause) == (DriverMode.SAFE_HOLD, HoldCause.COMMAND_EXPIRED)
