"""The life of a distributed run: hello, grants, watch, end. No data passes through here.

Simulated time may go as far as the conductor grants: at most `WINDOW` beyond the exam state it has seen, so that the end tick,
which planning announces a second ahead, is never overrun; at most a second beyond what the recorder has written; and, in real
time, not beyond the wall clock.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from time import monotonic, perf_counter, sleep, time_ns
from typing import Any

import zenoh
from palpate_bus import codec
from palpate_bus.contract import MS, Contract
from palpate_bus.lockstep import NEVER, run_hash
from palpate_bus.member import Member
from palpate_bus.messages import OperatorRequest, RunControl, ServiceReport
from palpate_bus.observer import ObservedService
from palpate_bus.stamps import NS, header

from palpate_conductor.collector import Collector
from palpate_conductor.contract_watch import ContractWatch
from palpate_conductor.handover import Places
from palpate_conductor.operator import OperatorDesk
from palpate_conductor.service_health import service_statuses
from palpate_conductor.watchdog import Watchdog

log = logging.getLogger(__name__)

WINDOW = 500 * MS
"""Simulated time granted beyond the newest exam state; less than the second by which planning announces the end."""
RECORDER_WINDOW = NS
AFTER_LOSS = NS
"""Simulated time that survivors run after a loss, so that the safe reaction is simulated and recorded."""
POLL_S = 0.01
WALLCLOCK_LEAD = 200 * MS
"""Between the word to start and the common start [ns]."""
REGRANT_S = 0.5
EXAM_SILENT_S = 10.0
"""Without a new exam state for so long a wall-clock run is ended: nobody would say its end."""
OBSERVERS_FINISH_S = 60.0


@dataclass(frozen=True)
class Patience:
    """How long the conductor waits [s], by wall clock."""

    start: float = 90.0
    """For every service to answer on every edge."""
    soft: float = 5.0
    """Without a finished tick before it says who blocks."""
    hard: float = 120.0
    """Without a finished tick before it ends the run."""
    absent: tuple[str, ...] = ()
    """Roles that somebody else starts ..."""
    join: float = 300.0
    """... and how long after all others have answered."""


@dataclass
class Outcome:
    """How a run went."""

    digests: dict[str, str] = field(default_factory=dict)
    reports: dict[str, Mapping[str, Any]] = field(default_factory=dict)
    """What each service reported at its end: blame, counters, facts."""
    first_tick_wall: float = 0.0
    wall_time_s: float = 0.0
    last_tick: int = NEVER
    trouble: list[str] = field(default_factory=list)
    """A sentence for each loss."""
    lost: dict[str, int] = field(default_factory=dict)
    """Tick [ns] at which each lost service fell silent."""
    failure: str | None = None
    """Service and cause, None when the run completed."""
    interrupted: bool = False
    """Whether it was ended by Ctrl-C or SIGTERM."""

    @property
    def run_hash(self) -> str | None:
        """The run hash, None for a run that did not complete."""
        return None if self.failure else run_hash(self.digests)


class RunFailed(RuntimeError):
    """The run ended early. Names the service and the cause."""


class Conductor:
    """Conducts one distributed lockstep run of `roles` (observers among them)."""

    def __init__(
        self,
        session: zenoh.Session,
        rules: Contract,
        domain: int,
        roles: tuple[str, ...],
        collector: Collector,
        patience: Patience | None = None,
        realtime: float | None = None,
        limit: int | None = None,
        wallclock: bool = False,
        handover_s: float = 0.0,
    ) -> None:
        """Prepares a run.

        `realtime` paces it at so many simulated seconds a wall second; `limit` [ns] ends a run that nobody else ends.
        With `wallclock` the services run on their own timers, and nothing is granted but the common start and the end; the place
        of a service that goes is kept for `handover_s`, if the run can do without it for that time (see `handover`).
        """
        member = Member(session, collector.role, rules, domain)
        self._member = member
        self._rules = rules
        self._workers = tuple(role for role in roles if not rules.roles[role].observer)
        self._observers = tuple(role for role in roles if rules.roles[role].observer)
        self._roles = roles
        self._collector = collector
        self._observed = ObservedService(collector, member, lossless=True)
        self._desk = OperatorDesk(session, domain, self.request, self.pace)
        self._patience = patience or Patience()
        self._realtime = realtime
        self._limit = limit
        self._wallclock = wallclock
        self._places = Places(handover_s if wallclock else 0.0)
        self._epoch = 0
        self._control = member.internal_publisher("palpate/control", "palpation_msgs/msg/RunControl", "event")
        self._encode = codec.encoder("palpation_msgs/msg/RunControl")
        self._decode = codec.decoder("palpation_msgs/msg/ServiceReport")
        self._reports = {
            role: member.internal_subscription(f"palpate/report/{role}", "palpation_msgs/msg/ServiceReport") for role in roles
        }
        self._sequence = 0
        self.watchdog = Watchdog(roles, {name: topic.producer for name, topic in rules.topics.items()})
        self.outcome = Outcome()
        self._contract = ContractWatch(session, rules, domain, wallclock)
        collector.diagnose = self._diagnose
        self.horizon = NEVER
        self._paused = False
        self._last = False
        self._granted_at = 0.0
        self._started_at = 0.0
        self._paced_since, self._paced_from = 0.0, 0
        self._complained = False
        self._exam_seen, self._exam_seen_at = -1, 0.0
        self.started_at_perf = 0.0

    @property
    def elapsed_s(self) -> float:
        """Wall time [s] since the first tick was granted."""
        return monotonic() - self._started_at if self._started_at else 0.0

    # -- talking to the services

    def _say(self, command: int, tick: int = 0, last: bool = False, role: str = "", reason: str = "") -> None:
        self._sequence += 1
        self._control.put(self._encode(RunControl(command, tick, last, role, reason)), self._sequence)

    def _grant(self, tick: int, last: bool = False) -> None:
        self.horizon = tick
        self._last = last
        self._granted_at = monotonic()
        self._say(RunControl.GRANT, tick, last)

    def request(self, request: int, reason: str) -> None:
        """Passes an operator's request on to robot, supervisor and planning; see `palpation_msgs/OperatorRequest`."""
        port = self._observed.stepper.ports["operator/request"]
        t = max(self._observed.now, 0)
        payload = port.pack(OperatorRequest(header(t), request, reason))
        self._observed.publishers["operator/request"].put(payload, port.sequence)

    def abort(self, reason: str) -> None:
        """Tells every service to stop at once."""
        self._say(RunControl.ABORT, reason=reason)

    def _heard(self) -> list[tuple[str, Any, dict[str, Any]]]:
        """New reports: (role, message, detail)."""
        heard = []
        for role, subscription in self._reports.items():
            while (sample := subscription.get(0)) is not None:
                message = self._decode(sample.payload)
                self.watchdog.report(role, int(message.tick), message.waiting_for)
                heard.append((role, message, json.loads(message.detail) if message.detail else {}))
        return heard

    def _diagnose(self) -> list[Any]:
        """Services, then topics, for `diagnostics`."""
        services = service_statuses(self.watchdog.progress, self.outcome.lost, self._patience.soft, self._contract.of)
        return [*services, *self._contract.statuses()]

    # -- the run

    def run(
        self,
        died: Callable[[], Mapping[str, str]] = dict,
        tell: Callable[[Conductor], None] = lambda _: None,
    ) -> Outcome:
        """Runs to the end. `died` gives the roles whose process is gone, with how; `tell` is called often, for progress.

        Raises RunFailed when the run cannot start; later failures are in the outcome, KeyboardInterrupt among them.
        """
        try:
            self._handshake(died)
        except KeyboardInterrupt:
            self.outcome.interrupted = True
            self.abort("interrupted")
            raise RunFailed("interrupted before the first tick") from None
        self._started_at = self._paced_since = monotonic()
        self.started_at_perf = perf_counter()
        self.watchdog.forgive()
        self._epoch = time_ns() + WALLCLOCK_LEAD
        self._grant(self._epoch if self._wallclock else WINDOW - MS)
        try:
            self._conduct(died, tell)
            self.outcome.wall_time_s = monotonic() - self._started_at
            self._end(died)
        except (RunFailed, KeyboardInterrupt) as failure:
            self.outcome.interrupted = isinstance(failure, KeyboardInterrupt)
            why = f"interrupted at tick {max(self._observed.now, 0) / NS:.3f} s" if self.outcome.interrupted else str(failure)
            self.outcome.failure = self.outcome.failure or why
            self.outcome.wall_time_s = monotonic() - self._started_at
            self.abort(why)
        self._desk.close()
        self._contract.close()
        self.outcome.last_tick = max((p.tick for p in self.watchdog.progress.values()), default=NEVER)
        self._observed.drain_and_step()
        return self.outcome

    def _handshake(self, died: Callable[[], Mapping[str, str]]) -> None:
        ready: dict[str, list[str]] = {}
        begin = met = monotonic()
        ours = set(self._roles) - set(self._patience.absent)
        while len(ready) < len(self._roles) or any(ready.values()):
            self._say(RunControl.HELLO)
            sleep(0.05)
            for role, message, detail in self._heard():
                if message.state == ServiceReport.FAILED:
                    raise RunFailed(f"{role} failed at start: {detail.get('error')}")
                if message.state != ServiceReport.READY:
                    continue
                ready[role] = [name for name in detail.get("missing", []) if not self._absent(name)]
            for role, how in died().items():
                self.abort(f"{role} died at start")
                raise RunFailed(f"{role} died at start: {how}")
            if not ours <= ready.keys():
                met = monotonic()
            waits_for_others = bool(self._patience.absent) and ours <= ready.keys()
            since, patience = (met, self._patience.join) if waits_for_others else (begin, self._patience.start)
            if monotonic() - since > patience:
                silent = [role for role in self._roles if role not in ready]
                deaf = "; ".join(f"{role} hears nothing on {', '.join(keys)}" for role, keys in ready.items() if keys)
                self.abort("start timed out")
                raise RunFailed(
                    f"not ready after {patience:.0f} s: " + (f"no answer from {', '.join(silent)}. " if silent else "") + deaf
                )

    def _absent(self, name: str) -> bool:
        """Whether it is a topic whose producer has no part in this run."""
        topic = self._rules.topics.get(name)
        return topic is not None and topic.producer not in (*self._roles, self._collector.role)

    def _conduct(self, died: Callable[[], Mapping[str, str]], tell: Callable[[Conductor], None]) -> None:
        finished: set[str] = set()
        while not finished >= set(self._workers) - self.outcome.lost.keys():
            self._observed.drain_and_step()
            for role, message, detail in self._heard():
                if self._places.take(role):
                    self.watchdog.progress[role].moved = monotonic()  # the time before is nobody's
                    self._tell(f"another process plays {role} from {max(message.tick, 0) / NS:.3f} s on")
                if message.state == ServiceReport.FINISHED:
                    finished.add(role)
                    self._close(role, detail)
                elif message.state == ServiceReport.FAILED:
                    self._miss(role, detail.get("error", "unknown error"))
            for role, how in self._missing(died).items():
                if role in self._roles and role not in finished:
                    self._miss(role, how)
            for role, how in self._places.expired().items():
                self._lose(role, f"{how}; nobody took its place within {self._places.patience_s:.0f} s")
            for complaint in self._member.complaints():
                log.error("%s", complaint)
                self.outcome.trouble.append(complaint)
            self._desk.attend(self._collector.collected.supervisor)
            self._contract.attend()
            self._extend()
            self._watch()
            tell(self)
            sleep(POLL_S)

    def _extend(self) -> None:
        """Grants as much time as may be granted."""
        if self._wallclock:
            self._extend_wallclock()
            return
        if self._last:
            if monotonic() - self._granted_at > REGRANT_S:
                self._grant(self.horizon, last=True)
            return
        end = self._collector.collected.end_tick
        if end is None and self._limit is not None and self._collector.collected.exam_time + WINDOW >= self._limit:
            end = self._limit
        tick = max(self._collector.collected.exam_time, 0) + WINDOW
        for role in self._observers:
            if role == "recorder" and role not in self.outcome.lost:
                tick = min(tick, self.watchdog.progress[role].tick + RECORDER_WINDOW)
        if self._realtime is not None:
            tick = min(tick, self._paced_from + int((monotonic() - self._paced_since) * self._realtime * NS))
        tick -= tick % MS
        if self._paused:
            self.watchdog.forgive()
            tick = self.horizon
        if end is not None and end <= max(tick, self.horizon):
            if end < self.horizon:
                raise RunFailed(f"planning announced the end at {end} ns after {self.horizon} ns had been granted")
            self._grant(end, last=True)
        elif tick > self.horizon or monotonic() - self._granted_at > REGRANT_S:
            self._grant(max(tick, self.horizon))

    def _extend_wallclock(self) -> None:
        end, seen = self._collector.collected.end_tick, self._collector.collected.exam_time
        if seen != self._exam_seen:
            self._exam_seen, self._exam_seen_at = seen, monotonic()
        elif end is None and self._exam_seen_at and monotonic() - self._exam_seen_at > EXAM_SILENT_S:
            raise RunFailed(f"planning has sent nothing on exam/state since {seen / NS:.3f} s, for {EXAM_SILENT_S:.0f} s")
        if self._last or (end is None and monotonic() - self._granted_at > REGRANT_S):
            self._grant(self.horizon, self._last)
        elif end is not None:
            self._grant(end, last=True)

    def pace(self, word: str, ms: int) -> str:
        """Does a word of `desk.PACE` and says what came of it; `ms` of simulated time for `step`.

        Raises ValueError when it cannot be done.
        """
        if self._wallclock:
            raise ValueError("time is the wall's in this run: nothing can hold it")
        if self._last:
            raise ValueError("the run is ending")
        if word == "pause":
            self._paused = True
        elif not self._paused:
            raise ValueError("the run is not paused")
        elif word == "resume":
            self._paused = False
            self._paced_from, self._paced_since = self.horizon, monotonic()
            return "goes on"
        elif not 0 < ms <= WINDOW // MS:
            raise ValueError(f"a step of {ms} ms: want 1 to {WINDOW // MS}")
        else:
            self._grant(self.horizon + ms * MS)
        return f"stands at {(self.horizon + MS) / NS:.3f} s as soon as that is reached"

    def _watch(self) -> None:
        judged = [role for role in self._workers if role not in self.outcome.lost and role not in self._places.empty]
        stalled = self.watchdog.longest_stall(judged) if self._wallclock else self.watchdog.stalled_for()
        if stalled > self._patience.hard:
            role, sentence = self.watchdog.culprit(judged)
            raise RunFailed(f"{role} blocks the run for {stalled:.0f} s: {sentence}")
        if stalled > self._patience.soft and not self._complained:
            log.warning("no tick for %.0f s: %s", stalled, self.watchdog.culprit(judged)[1])
        self._complained = stalled > self._patience.soft

    def _missing(self, died: Callable[[], Mapping[str, str]]) -> dict[str, str]:
        """Roles that are not there, with how they went."""
        ended = {role: how for role, how in died().items() if role not in self._places.taken}
        return {**dict.fromkeys(self._member.gone(), "its connection is gone"), **ended}

    def _miss(self, role: str, how: str) -> None:
        """Keeps the place of a role that is gone, or marks it lost."""
        if not self._places.keeps(role) or role in self.outcome.lost:
            self._lose(role, how)
            return
        if self._places.leave(role, how):
            tick = max(self.watchdog.progress[role].tick, 0) / NS
            self._tell(f"{role} left at {tick:.3f} s: {how}; its place is kept for {self._places.patience_s:.0f} s")
            self._reports[role].hand_over()
            self._say(RunControl.HANDOVER, role=role, reason=how)

    def _tell(self, sentence: str) -> None:
        self.outcome.trouble.append(sentence)

    def _lose(self, role: str, how: str) -> None:
        """Marks a role lost at its last reported tick, and lets the others react."""
        if role in self.outcome.lost:
            return
        tick = max(self.watchdog.progress[role].tick, 0)
        row = self._rules.roles[role]
        self.outcome.lost[role] = tick
        sentence = f"{role} lost at tick {tick / 1e9:.3f} s: {how}"
        self.outcome.trouble.append(sentence)
        if row.observer:
            log.warning("%s; the run goes on", sentence)
            return
        self.outcome.failure = self.outcome.failure or sentence
        if row.critical:
            raise RunFailed(sentence)
        self._say(RunControl.LOST, tick, role=role, reason=how)
        reached = max(progress.tick for progress in self.watchdog.progress.values())
        self._grant(reached - reached % MS + AFTER_LOSS, last=True)

    def _close(self, role: str, detail: dict[str, Any]) -> None:
        self.outcome.reports[role] = detail
        self.outcome.digests.update(detail.get("digests", {}))

    def _end(self, died: Callable[[], Mapping[str, str]]) -> None:
        """Lets the observers take in what is left and close their files."""
        waiting = set(self._observers) - self.outcome.lost.keys()
        begin = monotonic()
        self._say(RunControl.END)
        while waiting and monotonic() - begin < OBSERVERS_FINISH_S:
            self._observed.drain_and_step()
            for role, message, detail in self._heard():
                if message.state == ServiceReport.FINISHED:
                    waiting.discard(role)
                    self._close(role, detail)
            for role, how in died().items():
                if role in waiting:
                    waiting.discard(role)
                    log.warning("%s died while closing: %s", role, how)
            sleep(POLL_S)
        for role in waiting:
            log.warning("%s did not finish within %.0f s", role, OBSERVERS_FINISH_S)
