"""The parts of the conductor, without services."""

import json
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import nullcontext
from threading import Event
from time import monotonic, sleep, time_ns
from types import SimpleNamespace
from typing import Any
from unittest import mock

import pytest
import typer
import zenoh

from palpate.exam_state import exam_state
from palpate.live import operator
from palpate_bus.contract import contract
from palpate_bus.messages import MS, NS, ExamState, IndentationTruth, Point, ServiceReport, SupervisorState, header
from palpate_bus.runs.announcement import BusTarget
from palpate_bus.runs.operator import TIME_REQUESTS, WORDS, NoConductorError, NotAnswered, ask, request_key
from palpate_bus.runtime.failure import FailureCode
from palpate_bus.runtime.lockstep import NEVER
from palpate_bus.runtime.member import Member
from palpate_bus.runtime.process import pid_space
from palpate_bus.wire.rmw import Tagger
from palpate_bus.wire.zenoh_config import BusOptions, close_session, open_session
from palpate_conductor import grants
from palpate_conductor.collector import EXAM_LIMIT, Collected, Collector, KeptMessages
from palpate_conductor.conductor import Conductor, conduct
from palpate_conductor.operator import OperatorRequestServer
from palpate_conductor.outcome import Patience, RunFailed, Timing, failure_of, incomplete, unsampled
from palpate_conductor.watchdog import FreezeWatch, Heartbeat, RunWatchdog
from palpate_errors import UserError
from palpate_models.scenario.load import exam_input, load_scenario
from palpate_models.scenario.schema import Exam

TOPIC = "truth/indentation"


def contact(k: int) -> IndentationTruth:
    return IndentationTruth(header(k * 10_000_000, "world"), 0.01 * k, 1 / (k + 1), 0.5, 2.5, 20, Point(0.1 * k, 0.2, 0.7), 6.8e5)


def test_kept_messages_equal_the_originals() -> None:
    messages, kept = [contact(k) for k in range(5)], KeptMessages(TOPIC)
    with pytest.raises(IndexError):
        kept[-1]
    kept.extend(messages[:3])
    kept.extend(messages[3:])
    assert len(kept) == 5
    assert list(kept) == list(kept) == messages
    assert (kept[1], kept[-1], kept[::2]) == (messages[1], messages[-1], messages[::2])


@pytest.mark.parametrize(
    ("phase", "announced", "end"),
    [
        (ExamState.PHASE_SCAN, -1, None),
        (ExamState.PHASE_DONE, 70, 70),
        (ExamState.PHASE_DONE, -1, 50 + NS),
        (ExamState.PHASE_ABORTED, -1, 50 + NS),
    ],
)
@pytest.mark.parametrize("at_once", [1, 3])
def test_an_examination_that_is_over_ends_the_run_at_one_tick_even_if_planning_announces_no_end(
    phase: int, announced: int, end: int | None, at_once: int
) -> None:
    collector, inbox = Collector(), mock.Mock(stamp=lambda topic: 0)
    states = [exam_state(t, phase, end_tick=announced) for t in (50, 60, 70)]
    for k in range(0, len(states), at_once):
        received = {"exam/state": states[k : k + at_once]}
        inbox.new.side_effect = lambda topic, received=received: received.get(topic, [])
        collector.step(0, inbox)
    assert collector.collected.end_tick == end


@pytest.fixture
def session() -> Iterator[zenoh.Session]:
    opened = open_session(BusOptions())
    yield opened
    close_session(opened)


def test_a_pause_has_a_bound_and_is_named(session: zenoh.Session) -> None:
    conductor = Conductor(session, contract(), 0, ("control",), Collector(), Patience(pause=0.3))
    conductor.grants.begin()
    conductor.grants.pace("pause", 0)
    conductor._extend_grant()
    assert any("palpate resume" in text for text in conductor.result.trouble)
    sleep(0.2)
    conductor.grants.pace("pause", 0)  # counts on
    sleep(0.2)
    with pytest.raises(RunFailed) as failed:
        conductor._extend_grant()
    assert failed.value.failure.code is FailureCode.STOPPED
    conductor.grants.pace("resume", 0)
    conductor._extend_grant()


def test_a_step_ends_at_the_announced_end() -> None:
    granted: list[tuple[int, bool]] = []
    stepped = grants.Grants(lambda tick, last: granted.append((tick, last)), Timing())
    stepped.begin()
    stepped.pace("pause", 0)
    stepped.extend(490 * MS, 1200 * MS, None)
    assert [stepped.pace("step", 400) for _ in range(2)] == ["pauses at 0.900 s", "ends at 1.201 s"]
    assert granted[-1] == (1200 * MS, True)
    assert not stepped.paused


def test_steps_do_not_pass_the_end_that_planning_may_announce_nor_what_the_recorder_can_take() -> None:
    stepped = grants.Grants(lambda tick, last: None, Timing())
    stepped.begin()
    stepped.pace("pause", 0)
    stepped.extend(490 * MS, None, 450 * MS)
    stepped.pace("step", 500)
    for recorded in (450, 400):  # both are behind, then only the recorder is
        with pytest.raises(UserError, match="step of 500 ms: planning or the recorder"):
            stepped.pace("step", 500)
        stepped.extend(990 * MS, None, recorded * MS)
    stepped.extend(990 * MS, None, 950 * MS)
    stepped.pace("step", 500)
    stepped.pace("resume", 0)
    stepped.extend(NS, 2 * NS, NS)  # announced a second ahead
    assert not stepped.last


@pytest.mark.parametrize("wallclock", [True, False])
def test_a_planning_that_never_ends_the_examination_ends_the_run_at_its_limit_incomplete(wallclock: bool) -> None:
    granted: list[tuple[int, bool]] = []
    limited = grants.Grants(lambda tick, last: granted.append((tick, last)), Timing(wallclock=wallclock, limit=2 * NS))
    limited.begin()
    limited.extend(1_400_000_000, None, None)
    assert not granted[-1][1]
    limited.extend(1_900_000_000, None, None)
    assert granted[-1] == (2 * NS, True)
    scanning = incomplete(Collected([exam_state(2 * NS, ExamState.PHASE_SCAN)]))
    assert scanning is not None
    assert (scanning.code, scanning.roles) == (FailureCode.UNENDED, ("planning",))
    assert incomplete(Collected([exam_state(2 * NS, ExamState.PHASE_DONE)], end_tick=2 * NS)) is None


@pytest.mark.parametrize(("phase", "asked"), [(ExamState.PHASE_SCAN, True), (ExamState.PHASE_ASSESS, False)])
def test_an_examination_is_ended_before_the_limit_of_the_run_and_its_report_says_so(phase: int, asked: bool) -> None:
    collector, inbox = Collector(), mock.Mock()
    requests = []
    for t in (EXAM_LIMIT - 10 * MS, EXAM_LIMIT, EXAM_LIMIT + 10 * MS):
        received = {"exam/state": [exam_state(t, phase)]}
        inbox.new.side_effect = lambda topic, received=received: received.get(topic, [])
        inbox.stamp.return_value = t
        requests.append("operator/request" in collector.step(t, inbox))
    assert requests == [False, asked, False]
    ended = exam_state(t, ExamState.PHASE_ABORTED, reason=ExamState.REASON_OPERATOR_END)
    failure = incomplete(Collected([ended], exam_time=t, end_tick=t))
    assert failure is not None
    assert (failure.code, failure.roles) == (FailureCode.UNENDED, ())


@pytest.mark.parametrize(
    ("samples", "spacing_m", "complete"), [(0, 0.0125, False), (7, 0.0125, False), (8, 0.0125, True), (4, 0.005, True)]
)
def test_targets_that_were_not_sampled_are_not_complete(samples: int, spacing_m: float, complete: bool) -> None:
    exam = Exam(spacing_m=spacing_m)
    done = exam_state(2 * NS, ExamState.PHASE_DONE, target_count=9, targets_skipped=1)
    found = unsampled(Collected([done], samples=[None] * samples), exam)
    assert (found is None) == complete
    assert unsampled(Collected([done], samples=[None] * 10), exam) is not None, "ten samples without a map"
    assert unsampled(Collected([done], samples=[None] * 10, stiffness_map=object()), exam) is None
    scanning = exam_state(NS, ExamState.PHASE_SCAN, steady=True)
    assert unsampled(Collected([scanning, done]), exam) is None, "an assessment need not publish samples"


def test_a_conductor_of_services_started_by_others_counts_the_samples(
    session: zenoh.Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    collected = Collected([exam_state(2 * NS, ExamState.PHASE_DONE, target_count=9)], end_tick=3 * NS)
    monkeypatch.setattr(Collector, "__init__", lambda self, tree: setattr(self, "collected", collected))
    monkeypatch.setattr(Conductor, "run", lambda *_: None)
    result = conduct(session, (), mock.Mock(), exam=exam_input(load_scenario("clean")))
    assert result.failure is not None
    assert result.failure.code is FailureCode.UNSAMPLED


def test_a_planning_that_never_sends_a_state_is_awaited_for_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(grants, "GRANTS", grants.GrantTuning(exam_silent_s=0.1))
    awaited = grants.Grants(lambda tick, last: None, Timing(wallclock=True))
    awaited.begin()
    awaited.extend(NEVER, None, None)
    sleep(0.2)
    with pytest.raises(RunFailed) as failed:
        awaited.extend(NEVER, None, None)
    assert failed.value.failure.code is FailureCode.EXAM_SILENT


# -- heartbeat and frozen processes


def test_a_process_without_a_connection_is_distinguished_from_one_that_exited() -> None:
    child = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)
    watch = FreezeWatch(Patience())
    watch.add("planning", {"pid": child.pid, "home": pid_space()})
    assert f"its process {child.pid} runs" in watch.connection_lost("planning")
    exited = watch.connection_lost("camera")
    child.kill()
    child.wait()
    assert watch.connection_lost("planning") == exited


def test_after_a_freeze_the_replacement_is_watched_and_the_frozen_process_is_not(session: zenoh.Session) -> None:
    children = [subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) for _ in range(2)]
    ready = [{"pid": child.pid, "home": pid_space()} for child in children]
    timing = Timing(wallclock=True, handover_s=60.0)
    conductor = Conductor(session, contract(), 0, ("control", "camera"), Collector(), Patience(frozen=0.4), timing)
    conductor._freezes.add("camera", ready[0])

    def empty_slots() -> set[str]:
        end = monotonic() + 1.5
        while monotonic() < end and not conductor._slots.empty:
            conductor._lose_frozen(())
            sleep(0.05)
        return {*conductor._slots.empty}

    try:
        children[0].send_signal(signal.SIGSTOP)
        assert empty_slots() == {"camera"}
        report = ServiceReport(ServiceReport.READY, "camera", NEVER, "", "")
        conductor._handle_report("camera", report, ready[1], set())
        assert not empty_slots()
        children[1].send_signal(signal.SIGSTOP)
        assert empty_slots() == {"camera"}
        assert not conductor.result.lost
    finally:
        for child in children:
            child.kill()
            child.wait()


@pytest.mark.parametrize(("wallclock", "beats", "stood_still_s"), [(True, False, 0.4), (False, False, 0.0), (True, True, 0.0)])
def test_a_standstill_is_longer_than_the_services_wait_and_stops_the_heartbeat(
    session: zenoh.Session, monkeypatch: pytest.MonkeyPatch, wallclock: bool, beats: bool, stood_still_s: float
) -> None:
    now = 100.0
    monkeypatch.setattr("palpate_conductor.watchdog.monotonic", lambda: now)
    beat = Heartbeat(Member(session, "conductor", contract(), 0), contract(), wallclock)
    beat.loop_turned()
    now += 0.4
    if beats:
        beat._sent_at = now - 0.1
    beat.loop_turned()
    assert beat.stood_still_s == pytest.approx(stood_still_s)


# -- the operator


def test_a_conductor_that_stands_still_is_not_taken_for_one_that_is_not_there(
    session: zenoh.Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("palpate_bus.runs.operator.CONFIRM_S", 0.2)
    with pytest.raises(NoConductorError):
        ask(session, 0, "stop", "test")
    queries: list[zenoh.Query] = []
    session.declare_queryable(request_key(0), queries.append)
    with pytest.raises(NotAnswered, match="still starting"):
        ask(session, 0, "stop", "test")
    assert len(queries) == 1


def test_a_run_that_does_not_answer_delays_the_stop_of_no_other(monkeypatch: pytest.MonkeyPatch) -> None:
    other_asked, asked = Event(), list[int]()

    def answer(joined: object, domain: int, *_: object) -> tuple[str, float]:
        asked.append(domain)
        if domain == 1:
            assert other_asked.wait(5)
            raise NotAnswered("it stands still")
        other_asked.set()
        return "the driver holds", 1.0

    monkeypatch.setattr(operator, "ask", answer)
    monkeypatch.setattr(operator, "session", lambda options: nullcontext())
    monkeypatch.setattr(operator, "find_buses", lambda chosen: [BusTarget(BusOptions(), domain) for domain in (1, 2)])
    with pytest.raises(typer.Exit):
        operator.stop()
    assert sorted(asked) == [1, 2]


class Query:
    """A query of an operator."""

    def __init__(self, word: str, ms: int = 0, text: str = "", key: bytes | None = None) -> None:
        text = text or json.dumps({"word": word, "reason": "test", "ms": ms, "sent": time_ns()})
        tag = b"" if key is None else Tagger(key, "0/palpate/operator").tag(b"", text.encode())
        self.payload, self.attachment = zenoh.ZBytes(text), zenoh.ZBytes(tag)
        self.answer: dict[str, Any] = {}

    def reply(self, key: str, text: str) -> None:
        self.answer = json.loads(text)

    def drop(self) -> None:
        """Do nothing."""


class Operated:
    """The conductor's side of the operator, without a bus; all that it does is in `done`."""

    def __init__(self, pace: Any = None, key: bytes | None = None) -> None:
        session: Any = SimpleNamespace(declare_queryable=lambda key, handler: None)
        self.done: list[object] = []
        self.server = OperatorRequestServer(
            session, 0, lambda *sent: self.done.append(sent), pace or (lambda *asked: str(self.done.append(asked))), key
        )

    def poll(self, query: Query, *states: Any) -> tuple[Any, Any]:
        """Send the query in the first state; return what it is answered in the last."""
        self.done.clear()
        self.server._asked.put(query)
        for state in states or (None,):
            assert not query.answer, "an earlier state confirms nothing"
            self.server.poll(state)
        return query.answer.get("done"), query.answer.get("words")


def state(level: int, reason: str, releases: int = 0, refusals: int = 0) -> Any:
    return SupervisorState(header(0), level, 1, reason, releases, 0.0, -1.0, 0.0, refusals, "", 0.0)


REFUSED = state(2, "release refused: 45 N", refusals=1)


@pytest.mark.parametrize(
    ("before", "after", "answer"),
    [
        (REFUSED, state(0, "", releases=1, refusals=1), (True, "released")),
        (state(2, "45 N"), REFUSED, (False, "release refused: 45 N")),
    ],
)
def test_a_release_is_answered_by_the_next_state(before: Any, after: Any, answer: tuple[bool, str]) -> None:
    operated = Operated()
    assert operated.poll(Query("release"), before, after) == answer
    assert operated.done


def test_a_stop_before_the_first_tick_ends_the_run_and_a_release_is_refused(session: zenoh.Session) -> None:
    conductor = Conductor(session, contract(), 0, ("control",), Collector(), Patience(start=2.0))
    queries = Query("release"), Query("stop")
    for query in queries:
        conductor._operator_requests._asked.put(query)
    with pytest.raises(RunFailed, match="stopped by an operator before the first tick: test"):
        conductor.run()
    assert [query.answer.get("done") for query in queries] == [False, True]


def test_the_conductor_answers_requests_about_time() -> None:
    assert Operated(lambda word, ms: f"{word} {ms}").poll(Query("step", 3)) == (True, "step 3")
    refuse = mock.Mock(side_effect=UserError("wall-clock run"))
    assert Operated(refuse).poll(Query("step", 3)) == (False, "wall-clock run")


@pytest.mark.parametrize(
    "text", ["[" * 100_000, "[" * 3000, "9" * 4090, "[]", '{"word": ["stop"], "reason": ""}', '{"word": "stop"}']
)
def test_an_unreadable_request_is_answered(text: str) -> None:
    done, words = Operated().poll(Query("", text=text))
    assert not done
    assert words.startswith("no request")


@pytest.mark.parametrize("word", [*WORDS, *TIME_REQUESTS])
def test_in_a_run_with_a_key_only_its_holders_may_move_the_arm(word: str) -> None:
    key = bytes(32)
    operated = Operated(key=key)
    valid = Query(word, key=key)
    operated.poll(valid)
    assert operated.done
    for query in (Query(word), Query(word, key=bytes(31) + b"k"), valid):  # the last is a replay
        query.answer = {}
        operated.poll(query)
        assert bool(operated.done) is (word in ("stop", "soft-stop", "pause"))


# -- the watchdog


PRODUCERS = {"joint_states": "robot", "control/joint_torque": "control", "sim/contact_wrench": "tissue", "exam/state": "planning"}
ROLES = ("robot", "control", "tissue", "planning", "assessment")


@pytest.fixture
def watchdog() -> RunWatchdog:
    return RunWatchdog((*ROLES, "dashboard"), PRODUCERS)


@pytest.mark.parametrize(
    ("reports", "silent", "roles", "words"),
    [
        (
            [("control", 5, "joint_states"), ("robot", 5, "sim/contact_wrench"), ("tissue", 4, "")],
            "",
            {"tissue"},
            r"control \(for joint_states\).*robot \(for sim/contact_wrench\)",
        ),
        ([("control", 1, "joint_states"), ("robot", 1, "control/joint_torque")], "", {"control", "robot"}, "cycle"),
        # it reports while it waits, not in its step
        ([("planning", 2, "sim/contact_wrench"), ("tissue", 1, "exam/state")], "tissue", {"tissue"}, "^(?!.*cycle)"),
        ([(role, 1, "grant") for role in ROLES], "", {"conductor"}, ""),
    ],
    ids=["one does not wait", "a cycle", "one computes", "no grant"],
)
def test_the_culprit_is_who_lets_the_others_wait(
    watchdog: RunWatchdog, reports: list[tuple[str, int, str]], silent: str, roles: set[str], words: str
) -> None:
    for report in reports:
        watchdog.report(*report)
    if silent:
        watchdog.progress[silent].reported -= 1.0
    role, text = watchdog.culprit(ROLES)
    assert role in roles
    assert re.search(words, text), text


def test_only_a_finished_tick_counts_as_movement(watchdog: RunWatchdog) -> None:
    watchdog.report("robot", 1_000_000, "")
    before = watchdog.progress["robot"].moved
    watchdog.report("robot", 1_000_000, "control/joint_torque")
    assert watchdog.progress["robot"].moved == before


def test_only_the_given_roles_can_be_the_culprit(watchdog: RunWatchdog) -> None:
    for role, progress in watchdog.progress.items():
        progress.moved -= 100.0
        if role in ROLES:
            watchdog.report(role, 1_000_000, "")
    stalls = [watchdog.longest_stall(roles) for roles in ((*ROLES, "dashboard"), ROLES, ())]
    assert stalls[0] > 99.0
    assert stalls[1] < 50.0
    assert stalls[2] < 1.0
    assert watchdog.culprit(ROLES)[0] != "dashboard"


def test_every_error_has_a_failure_code() -> None:
    unexpected = failure_of(ValueError("odd"), 0)
    assert (unexpected.code, unexpected.roles) == (FailureCode.INTERNAL, ("conductor",))
    assert "ValueError: odd" in unexpected.text
    interrupted = failure_of(KeyboardInterrupt(), 2_500_000_000)
    assert (interrupted.code, interrupted.text) == (FailureCode.INTERRUPTED, "interrupted at 2.500 s")
