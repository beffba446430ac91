"""The life of a distributed run: hello, grants (`grants`), watch, end. No data passes through here."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Container, Iterable, Mapping
from time import monotonic, perf_counter, sleep
from typing import Any

import zenoh

from palpate_bus.contract import MS, Contract
from palpate_bus.messages import OperatorRequest, RunControl, ServiceReport, codec
from palpate_bus.messages.stamps import NS, header
from palpate_bus.runtime.conductor_link import CONDUCTOR, TRANSPORT_LOST
from palpate_bus.runtime.lockstep import NEVER
from palpate_bus.runtime.member import Member
from palpate_bus.runtime.observer import ObservedService
from palpate_conductor.collector import Collector
from palpate_conductor.contract_watch import ContractWatch
from palpate_conductor.freezes import FreezeWatch
from palpate_conductor.grants import Grants
from palpate_conductor.handover import Places
from palpate_conductor.heartbeat import Heartbeat
from palpate_conductor.operator import OperatorRequestServer
from palpate_conductor.outcome import Patience, RunFailed, RunOutcome, in_words
from palpate_conductor.service_health import service_statuses
from palpate_conductor.timing import Timing
from palpate_conductor.watchdog import RunWatchdog

log = logging.getLogger(__name__)

AFTER_LOSS = NS
"""Simulated time that survivors run after a loss, so that the safe reaction is simulated and recorded."""
POLL_S = 0.02
"""How often it looks [s]: at who died, at reports, and at what there is to grant."""
OBSERVERS_FINISH_S = 60.0
SILENT_S = 2.0
"""When all services are silent for so long, it is their way to the conductor that is at fault."""


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
        timing: Timing | None = None,
    ) -> None:
        """Prepares a run."""
        timing = timing or Timing()
        member = Member(session, collector.role, rules, domain)
        self._member = member
        self._rules = rules
        self._workers = tuple(role for role in roles if not rules.roles[role].observer)
        self._observers = tuple(role for role in roles if rules.roles[role].observer)
        self._roles = roles
        self._collector = collector
        self._observed = ObservedService(collector, member, lossless=True)
        self._patience = patience or Patience()
        self._wallclock = timing.wallclock
        self._places = Places(timing.handover_s if timing.wallclock else 0.0)
        self._control = member.internal_publisher("palpate/control", "palpation_msgs/msg/RunControl", "event")
        self._encode = codec.encoder("palpation_msgs/msg/RunControl")
        self._decode = codec.decoder("palpation_msgs/msg/ServiceReport")
        self._reports = {
            role: member.internal_subscription(f"palpate/report/{role}", "palpation_msgs/msg/ServiceReport") for role in roles
        }
        self._beside = {role: (role,) for role in roles}
        """By role, who shares its process, itself included."""
        self._sequence = 0
        self._heartbeat = Heartbeat(member, rules, timing.wallclock)
        self._freezes = FreezeWatch(self._patience)
        self.watchdog = RunWatchdog(roles, {name: topic.producer for name, topic in rules.topics.items()})
        self.outcome = RunOutcome()
        self._contract = ContractWatch(session, rules, domain, timing.wallclock_rate)
        collector.diagnose = self.diagnose
        self.grants = Grants(lambda tick, last: self._say(RunControl.GRANT, tick, last), timing)
        self._operator_requests = OperatorRequestServer(session, domain, self.request, self.grants.pace)
        self._started_at = 0.0
        self._complained = False
        self.started_at_perf = 0.0

    @property
    def elapsed_s(self) -> float:
        """Wall time [s] since the first tick was granted."""
        return monotonic() - self._started_at if self._started_at else 0.0

    # -- talking to the services

    def _say(self, command: int, tick: int = 0, last: bool = False, role: str = "", reason: str = "") -> None:
        self._sequence += 1
        self._control.put(self._encode(RunControl(command, tick, last, role, reason)), self._sequence)

    def request(self, request: int, reason: str) -> None:
        """Passes an operator's request on to robot, supervisor and planning; see `palpation_msgs/OperatorRequest`."""
        port = self._observed.stepper.ports["operator/request"]
        t = max(self._observed.now, 0)
        _, packet = port.pack(OperatorRequest(header(t), request, reason), t)
        self._observed.publishers["operator/request"].put(packet.payload, packet.sequence)

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
                detail = json.loads(message.detail) if message.detail else {}
                self._suspect(detail.get("suspicions", ()))
                heard.append((role, message, detail))
        return heard

    def _suspect(self, sentences: Iterable[str]) -> None:
        """Passes on, once, what is suspicious about a sender."""
        for sentence in sentences:
            if sentence not in self.outcome.trouble:
                self._tell(sentence)

    def diagnose(self) -> list[Any]:
        """Services, then topics, for `diagnostics`."""
        services = service_statuses(self.watchdog.progress, self.outcome.lost, self._patience.soft, self._contract.of)
        return [*services, *self._contract.statuses()]

    # -- the run

    def run(
        self,
        died: Callable[[], Mapping[str, str]] = dict,
        tell: Callable[[Conductor], None] = lambda _: None,
    ) -> RunOutcome:
        """Runs to the end. `died` gives the roles whose process is gone, with how; `tell` is called often, for progress.

        Raises RunFailed when the run cannot start; later failures are in the outcome, KeyboardInterrupt among them.
        """
        self._heartbeat.start()
        try:
            return self._run(died, tell)
        finally:
            self._heartbeat.stop()

    def _run(self, died: Callable[[], Mapping[str, str]], tell: Callable[[Conductor], None]) -> RunOutcome:
        try:
            self._handshake(died)
        except KeyboardInterrupt:
            self.outcome.interrupted = True
            self.abort("interrupted")
            raise RunFailed("interrupted before the first tick") from None
        self._started_at = monotonic()
        self.started_at_perf = perf_counter()
        self.watchdog.forgive()
        self.grants.begin()
        try:
            self._conduct(died, tell)
            self.outcome.wall_time_s = monotonic() - self._started_at
            self._end(died)
            tell(self)
        except (Exception, KeyboardInterrupt, SystemExit) as failure:  # whatever it is, what was measured is to be told
            self.outcome.interrupted = isinstance(failure, KeyboardInterrupt)
            why = in_words(failure, self._observed.now)
            self._hear_who_missed_us()
            self.outcome.failure = self.outcome.failure or why
            self.outcome.wall_time_s = monotonic() - self._started_at
            self.abort(why)
            if isinstance(failure, RunFailed):  # told at once: to end the services and to write the report takes seconds
                if why not in "; ".join(self.outcome.trouble):
                    self._tell(why)
                tell(self)
        self._operator_requests.close()
        self._contract.close()
        self.outcome.last_tick = max((p.tick for p in self.watchdog.progress.values()), default=NEVER)
        self._observed.drain_and_step(last=True)
        return self.outcome

    def _handshake(self, died: Callable[[], Mapping[str, str]]) -> None:
        ready: dict[str, list[str]] = {}
        begin = met = monotonic()
        ours = set(self._roles) - set(self._patience.absent)
        told = False
        while len(ready) < len(self._roles) or any(ready.values()):
            self._heartbeat.turn()
            self._contract.attend()  # it hears the answers, too, and must not fill up
            self._say(RunControl.HELLO)
            sleep(0.05)
            for role, message, detail in self._heard():
                if message.state == ServiceReport.FAILED:
                    raise RunFailed(f"{role} failed at start: {detail.get('error')}")
                if message.state != ServiceReport.READY:
                    continue
                self._freezes.meet(role, detail)
                self._beside[role] = tuple(detail.get("process", (role,)))
                ready[role] = [name for name in detail.get("missing", []) if not self._absent(name)]
            if dead := died():
                how = next(iter(dead.values()))
                who = ", ".join(role for role, end in dead.items() if end == how)
                self.abort(f"{who} died at start")
                raise RunFailed(f"{who} died at start: {how}")
            if not ours <= ready.keys():
                met = monotonic()
                if not told and met - begin > self._patience.quiet_start:
                    late = ", ".join(sorted(ours - ready.keys()))
                    self._tell(f"still starting: {late}; a first run compiles, which takes a minute or more")
                    told = True
            waits_for_others = bool(self._patience.absent) and ours <= ready.keys()
            since, patience = (met, self._patience.join) if waits_for_others else (begin, self._patience.start)
            if monotonic() - since > patience:
                silent = [role for role in self._roles if role not in ready]
                deaf = "; ".join(f"{role} hears nothing on {', '.join(keys)}" for role, keys in ready.items() if keys)
                self.abort("start timed out")
                raise RunFailed(
                    f"not ready after {patience:.0f} s: " + (f"no answer from {', '.join(silent)}. " if silent else "") + deaf
                )
        self._contract.take_in()  # all are there: the first diagnostics shall not miss who came last

    def _absent(self, name: str) -> bool:
        """Whether it is a topic whose producer has no part in this run."""
        topic = self._rules.topics.get(name)
        return topic is not None and topic.producer not in (*self._roles, self._collector.role)

    def _conduct(self, died: Callable[[], Mapping[str, str]], tell: Callable[[Conductor], None]) -> None:
        finished: set[str] = set()
        while not finished >= set(self._workers) - self.outcome.lost.keys():
            self._heartbeat.turn()
            self._observed.drain_and_step()
            for role, message, detail in self._heard():
                if message.waiting_for == CONDUCTOR:
                    self._missed(role, message.tick, detail.get("lost", ""))
                if "told" in detail:
                    when = max(message.tick, 0) / NS
                    raise RunFailed(
                        f"{role} was told to end at {when:.3f} s ({detail['told']}) in the conductor's name, "
                        "but not by this conductor: a forged or doubled sender of palpate/control"
                    )
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
            self._lose_frozen(finished)
            for role, how in self._places.expired().items():
                self._lose(role, f"{how}; nobody took its place within {self._places.patience_s:.0f} s")
            self._suspect([*self._member.complaints(), *self._member.suspicions()])
            self._operator_requests.attend(self._collector.collected.supervisor)
            self._contract.attend()
            self._extend()
            if self._wallclock and not finished:  # then it may say nothing any more
                self.watchdog.note_silence()
            self._watch()
            tell(self)
            sleep(POLL_S)

    def _extend(self) -> None:
        """Grants as much time as may be granted."""
        if self.grants.paused:
            self.watchdog.forgive()
        seen = self._collector.collected
        records = "recorder" in self._observers and "recorder" not in self.outcome.lost
        self.grants.extend(seen.exam_time, seen.end_tick, self.watchdog.progress["recorder"].tick if records else None)

    def _watch(self) -> None:
        judged = [role for role in self._workers if role not in self.outcome.lost and role not in self._places.empty]
        stalled = self.watchdog.longest_stall(judged) if self._wallclock else self.watchdog.stalled_for()
        if stalled > self._patience.hard:
            if (silent := self.watchdog.silent_for()) > SILENT_S:
                raise RunFailed(f"transport lost: nothing was heard of any service for {silent:.0f} s; no service is at fault")
            role, sentence = self.watchdog.culprit(judged)
            raise RunFailed(f"{role} blocks the run for {stalled:.0f} s: {sentence}")
        if stalled > self._patience.soft and not self._complained:
            log.warning("no tick for %.0f s, still waiting: %s", stalled, self.watchdog.culprit(judged)[1])
        self._complained = stalled > self._patience.soft

    def _lose_frozen(self, finished: Container[str]) -> None:
        """A frozen service is lost as a dead one is. In lockstep nobody can do without it, so nothing is left to react."""
        for role, how in self._freezes.frozen().items():
            if role in finished or role in self.outcome.lost:
                continue
            self._miss(role, how)
            if not self._wallclock and not self._rules.roles[role].observer:
                raise RunFailed(self.outcome.failure or how)

    def _missing(self, died: Callable[[], Mapping[str, str]]) -> dict[str, str]:
        """Roles that are not there, with how they went."""
        ended = {role: how for role, how in died().items() if role not in self._places.taken}
        gone = self._member.gone()
        hows = {role: self._freezes.gone(role) for role in gone - self.outcome.lost.keys() - ended.keys()}
        if gone and self._member.transport_lost():  # looked at last: services are missed before their router is
            reached = max(progress.tick for progress in self.watchdog.progress.values())
            raise RunFailed(f"transport lost at {max(reached, 0) / NS:.3f} s: {TRANSPORT_LOST}; no service is at fault")
        return {**hows, **ended}

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

    def _hear_who_missed_us(self) -> None:
        """Services that left while this conductor stood still are not at fault, whether their word still came or not."""
        for role, message, detail in self._heard():
            if message.waiting_for == CONDUCTOR:
                self._missed(role, message.tick, detail.get("lost", ""))
        if self._heartbeat.stood_still_s and CONDUCTOR not in self.outcome.lost:
            role = next(iter(self._workers))
            self._missed("", self.watchdog.progress[role].tick, "the services left without it")

    def _missed(self, role: str, tick: int, words: str) -> None:
        """A service, if known which, has not heard this conductor for the deadline: the examination ends, whatever comes now."""
        if CONDUCTOR in self.outcome.lost:
            return
        self.outcome.lost[CONDUCTOR] = max(tick, 0)
        stood = f"; it stood still for {self._heartbeat.stood_still_s:.1f} s" if self._heartbeat.stood_still_s else ""
        said = f"{role} says: {words}" if role else words
        sentence = f"conductor lost at {max(tick, 0) / NS:.3f} s: {said}{stood}"
        self._tell(sentence)
        self.outcome.failure = sentence

    def _tell(self, sentence: str) -> None:
        self.outcome.trouble.append(sentence)

    def _lose(self, role: str, how: str) -> None:
        """Marks a role and all that share its process lost at their last reported tick, and lets the others react."""
        if role in self.outcome.lost:
            return
        lost = self._beside[role]
        sentences = []
        for one in lost:
            tick = max(self.watchdog.progress[one].tick, 0)
            self.outcome.lost[one] = tick
            sentences.append(f"{one} lost at {tick / NS:.3f} s: {how}")
        self.outcome.trouble += sentences
        sentence = "; ".join(sentences)
        if self._rules.roles[role].observer:
            log.warning("%s; the run goes on", sentence)
            return
        self.outcome.failure = self.outcome.failure or sentence
        if any(self._rules.roles[one].critical for one in lost):
            raise RunFailed(sentence)
        for one in lost:
            self._say(RunControl.LOST, self.outcome.lost[one], role=one, reason=how)
        reached = max(progress.tick for progress in self.watchdog.progress.values())
        end = reached - reached % MS + AFTER_LOSS
        self.grants.grant(min(end, self.grants.horizon) if self.grants.last else end, last=True)

    def _close(self, role: str, detail: dict[str, Any]) -> None:
        self.outcome.reports[role] = detail
        self.outcome.digests.update(detail.get("digests", {}))

    def _end(self, died: Callable[[], Mapping[str, str]]) -> None:
        """Lets the observers take in what is left and close their files."""
        waiting = set(self._observers) - self.outcome.lost.keys()
        begin = monotonic()
        self._say(RunControl.END)
        while waiting and monotonic() - begin < OBSERVERS_FINISH_S:
            self._heartbeat.turn()
            self._observed.drain_and_step()
            dead = died()
            sleep(POLL_S)  # who leaves reports its end right before
            for role, message, detail in self._heard():
                if message.state == ServiceReport.FINISHED:
                    waiting.discard(role)
                    self._close(role, detail)
                    self._suspect(filter(None, [detail.get("facts", {}).get("trouble")]))
            for role in waiting & dead.keys():
                self._tell(f"{role} died while closing: {dead[role]}")
            waiting -= dead.keys()
        for role in waiting:
            self._tell(f"{role} did not finish within {OBSERVERS_FINISH_S:.0f} s")
