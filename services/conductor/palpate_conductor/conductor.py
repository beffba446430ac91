"""Conducts a distributed run: handshake, grants (`grants`), supervision of the processes, end. No data passes through here."""

from __future__ import annotations

import logging
from collections.abc import Callable, Container, Mapping, Set
from time import perf_counter, sleep
from typing import Any, NamedTuple

import zenoh

from palpate_bus.contract import CONDUCTOR, Contract, contract
from palpate_bus.messages import MS, NS, OperatorRequest, RunControl, ServiceReport, codec, header
from palpate_bus.runtime.conductor_link import CONTROL_TYPE, REPORT_TYPE, TRANSPORT_LOST
from palpate_bus.runtime.failure import Failure, FailureCode
from palpate_bus.runtime.lockstep import run_hash
from palpate_bus.runtime.member import Member
from palpate_bus.runtime.observer import ObservedService
from palpate_bus.runtime.process import rare_collections
from palpate_bus.settings import Settings, variable
from palpate_conductor.collector import Collector, FrameTree
from palpate_conductor.grants import GRANTS, Grants
from palpate_conductor.handover import Slots
from palpate_conductor.operator import OperatorRequestServer
from palpate_conductor.outcome import Patience, RunFailed, RunProgress, RunResult, Tell, Timing, failure_of, incomplete, unsampled
from palpate_conductor.watchdog import ContractWatch, FreezeWatch, Heartbeat, RunWatchdog, service_statuses
from palpate_errors import UserError
from palpate_inputs import InputError, parse_json
from palpate_models.scenario.schema import ExamInput

log = logging.getLogger(__name__)


class ConductorTuning(NamedTuple):
    """Periods and time limits of the conductor's loop."""

    poll_s: float = 0.02
    handshake_poll_s: float = 0.05
    after_loss_ns: int = NS
    """Simulated time that the others run after a loss, so that the safe reaction is simulated and recorded."""
    observers_finish_s: float = 60.0
    report_characters: int = 1 << 20
    """A service's report with longer details is dropped."""
    silent_s: float = 2.0
    """If all services are silent for longer, the connection to the conductor is at fault."""


TUNING = ConductorTuning()


class Conductor:
    """Conducts one distributed run of `roles`, observers included."""

    def __init__(
        self,
        session: zenoh.Session,
        contract: Contract,
        domain: int,
        roles: tuple[str, ...],
        collector: Collector,
        patience: Patience | None = None,
        timing: Timing | None = None,
    ) -> None:
        timing = timing or Timing()
        member = Member(session, collector.role, contract, domain)
        self._member = member
        self._contract = contract
        self._workers = tuple(role for role in roles if not contract.roles[role].observer)
        self._observers = tuple(role for role in roles if contract.roles[role].observer)
        self._roles = roles
        self._collector = collector
        self._observed = ObservedService(collector, member, lossless=True)
        self._patience = patience or Patience()
        self._wallclock = timing.wallclock
        self._slots = Slots(timing.handover_s if timing.wallclock else 0.0)
        self._control = member.internal_publisher("palpate/control", CONTROL_TYPE, "event")
        self._encode, self._decode = codec.encoder(CONTROL_TYPE), codec.decoder(REPORT_TYPE)
        self._subscriptions = {role: member.internal_subscription(f"palpate/report/{role}", REPORT_TYPE) for role in roles}
        self._process_roles = {role: (role,) for role in roles}
        """All roles of a role's process, by role."""
        self._sequence = 0
        self._heartbeat = Heartbeat(member, contract, timing.wallclock)
        self._freezes = FreezeWatch(self._patience)
        self.watchdog = RunWatchdog(roles, {name: topic.producer for name, topic in contract.topics.items()})
        self.result = RunResult("wallclock" if timing.wallclock else "distributed", collector.collected)
        self._watch = ContractWatch(session, contract, domain, timing.wallclock_rate)
        collector.diagnose = self.diagnose
        self.grants = Grants(lambda tick, last: self._send(RunControl.GRANT, tick, last), timing)
        self._operator_requests = OperatorRequestServer(session, domain, self.request, self.grants.pace, member.transport.key)
        self.started_at = 0.0
        """When the first grant was sent, by `perf_counter` [s]; 0 before."""
        self._warned = False

    @property
    def elapsed_s(self) -> float:
        """Wall time [s] since the first grant."""
        return perf_counter() - self.started_at if self.started_at else 0.0

    # -- messages to and from the services

    def _send(self, command: int, tick: int = 0, last: bool = False, role: str = "", reason: str = "") -> None:
        self._sequence += 1
        self._control.put(self._encode(RunControl(command, tick, last, role, reason)), self._sequence)

    def request(self, request: int, reason: str) -> None:
        """Publish an operator's request for robot, supervisor and planning; see `palpation_msgs/OperatorRequest`.

        Before the first tick no service would respond: a stop raises RunFailed, a release UserError.
        """
        if not self.started_at:
            if request == OperatorRequest.RELEASE:
                raise UserError("the run has not begun, so nothing is stopped")
            self.abort(reason)
            raise RunFailed(FailureCode.STOPPED, f"stopped by an operator before the first tick: {reason}")
        port = self._observed.stepper.ports["operator/request"]
        t = max(self._observed.now, 0)
        _, packet = port.pack(OperatorRequest(header(t), request, reason), t)
        self._observed.publishers["operator/request"].put(packet.payload, packet.sequence)

    def abort(self, reason: str) -> None:
        """Tell every service to stop at once."""
        self._send(RunControl.ABORT, reason=reason)

    def _receive_reports(self) -> list[tuple[str, Any, dict[str, Any]]]:
        """Return new reports: (role, message, detail)."""
        reports = []
        for role, subscription in self._subscriptions.items():
            while (sample := subscription.get(0)) is not None:
                try:
                    message = self._decode(sample.payload)
                    detail = parse_json(message.detail[: TUNING.report_characters] or "{}", f"palpate/report/{role}")
                    if not isinstance(detail, dict):
                        raise InputError(f"palpate/report/{role}: not an object")
                except (codec.CodecError, InputError) as error:
                    self._notify(f"a report is dropped: {error}")
                    continue
                self.watchdog.report(role, int(message.tick), message.waiting_for)
                self._notify(*detail.get("suspicions", ()))
                if message.waiting_for == CONDUCTOR:
                    self._on_heartbeat_timeout(role, message.tick, detail.get("conductor_lost", ""))
                reports.append((role, message, detail))
        return reports

    def _notify(self, *texts: str) -> None:
        """Add messages for the user, each once."""
        self.result.trouble += [text for text in texts if text not in self.result.trouble]

    def diagnose(self) -> list[Any]:
        """Return the statuses of services, then topics, for `diagnostics`."""
        services = service_statuses(self.watchdog.progress, self.result.lost, self._patience.soft, self._watch.violations)
        return [*services, *self._watch.statuses()]

    # -- the run

    def run(
        self, exited: Callable[[], Mapping[str, str]] = dict, tell: Callable[[Conductor], None] = lambda _: None
    ) -> RunResult:
        """Run to the end. `exited` gives the roles whose process ended, with a text of the reason; `tell` is called often.

        Raises RunFailed if the run cannot start; later failures, KeyboardInterrupt included, are in the outcome.
        """
        self._heartbeat.start()
        try:
            return self._run(exited, tell)
        finally:
            self._heartbeat.stop()

    def _run(self, exited: Callable[[], Mapping[str, str]], tell: Callable[[Conductor], None]) -> RunResult:
        try:
            self._handshake(exited, tell)
        except KeyboardInterrupt:
            self.result.interrupted = True
            self.abort("interrupted")
            raise RunFailed(FailureCode.INTERRUPTED, "interrupted before the first tick") from None
        self.started_at = perf_counter()
        self.watchdog.restart()
        self.grants.begin()
        try:
            self._conduct(exited, tell)
            self.result.wall_time_s = self.elapsed_s
            self._end(exited, tell)
            tell(self)
        except (Exception, KeyboardInterrupt, SystemExit) as error:  # the report needs what was measured, whatever ended the run
            self.result.interrupted = isinstance(error, KeyboardInterrupt)
            failure = failure_of(error, self._observed.now)
            self._collect_heartbeat_timeouts()
            known = self.result.failure is not None and failure.roles and set(failure.roles) <= self.result.lost.keys()
            self.result.failure = self.result.failure or failure
            self.result.wall_time_s = self.elapsed_s
            self.abort(failure.text)
            if isinstance(error, RunFailed):  # before the services end and the report is written, which takes seconds
                self._notify(*([] if known else [failure.text]))
                tell(self)
        self._operator_requests.close()
        self._watch.close()
        self.result.sim_time_s = self.watchdog.reached / NS
        self._observed.drain_and_step(last=True)
        if not (self.result.failure or self._wallclock):
            self.result.run_hash = run_hash(self.result.digests)
        return self.result

    def _handshake(self, exited: Callable[[], Mapping[str, str]], tell: Callable[[Conductor], None]) -> None:
        """Send hellos until every service has answered and has a sender on every input."""
        missing_inputs: dict[str, list[str]] = {}
        begin = own_answered = perf_counter()
        own_roles = set(self._roles) - set(self._patience.absent)
        warned = False
        while len(missing_inputs) < len(self._roles) or any(missing_inputs.values()):
            self._heartbeat.loop_turned()
            self._operator_requests.poll(None)
            self._watch.poll()  # it receives the hellos, too, and must not fill up
            self._send(RunControl.HELLO)
            sleep(TUNING.handshake_poll_s)
            for role, message, detail in self._receive_reports():
                if message.state == ServiceReport.FAILED:
                    raise RunFailed(FailureCode.START_FAILED, f"{role} failed at start: {detail.get('error')}", role)
                if message.state != ServiceReport.READY:
                    continue
                self._freezes.add(role, detail)
                self._process_roles[role] = tuple(detail.get("process", (role,)))
                missing_inputs[role] = [name for name in detail.get("missing", []) if not self._not_in_run(name)]
            if ended := exited():
                how = next(iter(ended.values()))
                roles = [role for role, end in ended.items() if end == how]
                self.abort(f"{', '.join(roles)} exited at start")
                raise RunFailed(FailureCode.START_FAILED, f"{', '.join(roles)} exited at start: {how}", *roles)
            if not own_roles <= missing_inputs.keys():
                own_answered = perf_counter()
            joining = bool(self._patience.absent) and own_roles <= missing_inputs.keys()
            since, limit_s = (own_answered, self._patience.join) if joining else (begin, self._patience.start)
            if not joining and own_roles - missing_inputs.keys() <= self._patience.foreign:
                limit_s = min(limit_s, self._patience.foreign_start)
            silent = [role for role in self._roles if role not in missing_inputs]
            waits = [f"no answer from {', '.join(silent)}"] if silent else []
            waits += [f"{role} receives nothing on {', '.join(keys)}" for role, keys in missing_inputs.items() if keys]
            if not warned and perf_counter() - begin > self._patience.quiet:
                hint = "a first run compiles, which takes a minute or more"
                self._notify(f"still starting, {limit_s:.0f} s at most: {'; '.join(waits)}; {hint}")
                tell(self)
                warned = True
            if perf_counter() - since > limit_s:
                self.abort("start timed out")
                raise RunFailed(FailureCode.NO_ANSWER, f"not ready after {limit_s:.0f} s: {'; '.join(waits)}", *silent)
        self._watch.poll(force=True)  # so that the first diagnostics include the service that joined last

    def _not_in_run(self, name: str) -> bool:
        """Return True if `name` is a topic whose producer has no part in this run."""
        topic = self._contract.topics.get(name)
        return topic is not None and topic.producer not in (*self._roles, self._collector.role)

    def _conduct(self, exited: Callable[[], Mapping[str, str]], tell: Callable[[Conductor], None]) -> None:
        """Grant time until every worker has finished or is lost."""
        finished: set[str] = set()
        while not finished >= set(self._workers) - self.result.lost.keys():
            self._heartbeat.loop_turned()
            self._observed.drain_and_step()
            for role, message, detail in self._receive_reports():
                self._handle_report(role, message, detail, finished)
            for role, how in self._exited_roles(exited).items():
                if role in self._roles and role not in finished:
                    self._keep_slot_or_lose(role, Failure(FailureCode.ROLE_LOST, how))
            self._lose_frozen(finished)
            for role, how in self._slots.remove_expired().items():
                reason = f"{how}; no replacement joined within {self._slots.patience_s:.0f} s"
                self._mark_lost(role, Failure(FailureCode.ROLE_LOST, reason))
            for role in self._slots.empty:
                self._send(RunControl.HELLO, role=role)  # a replacement answers with the id of its process
            self._notify(*self._member.complaints(), *self._member.suspicions())
            self._operator_requests.poll(self._collector.collected.supervisor)
            self._watch.poll()
            self._extend_grant()
            self._check_progress(finished)
            tell(self)
            sleep(TUNING.poll_s)

    def _handle_report(self, role: str, message: Any, detail: dict[str, Any], finished: set[str]) -> None:
        when = f"{max(message.tick, 0) / NS:.3f} s"
        if "ended_by" in detail:
            text = f"{role} ended at {when} on a message that this conductor did not send ({detail['ended_by']})"
            forged = f"{text}: a forged or doubled sender of palpate/control"
            raise RunFailed(FailureCode.FORGED, forged, role, topics=("palpate/control",))
        if self._slots.fill(role):
            self.watchdog.restart(role)  # the time before does not count as a stall
            self._freezes.add(role, detail)
            self._notify(f"another process replaces {role} from {when} on")
        if message.state == ServiceReport.FINISHED:
            finished.add(role)
            self._store_report(role, detail)
        elif message.state == ServiceReport.FAILED:
            self._keep_slot_or_lose(role, Failure.from_report(role, detail))

    def _extend_grant(self) -> None:
        if self.grants.paused:
            self.watchdog.restart()
            self._notify(f"paused by an operator: waiting for palpate resume, {self._patience.pause:g} s at most")
            if self.grants.paused_s > self._patience.pause:
                raise RunFailed(FailureCode.STOPPED, f"paused for {self._patience.pause:g} s without palpate resume")
        if self.grants.exam_silent_s > self._patience.quiet:
            self._notify(f"waiting for exam/state of planning, {GRANTS.exam_silent_s:g} s at most")
        collected = self._collector.collected
        records = "recorder" in self._observers and "recorder" not in self.result.lost
        recorded = self.watchdog.progress["recorder"].tick if records else None
        self.grants.extend(collected.exam_time, collected.end_tick, recorded)

    def _check_progress(self, finished: Set[str]) -> None:
        """Warn about a stall, and end the run if it lasts too long, or a step of a foreign service does."""
        limit_s = self._patience.foreign_step
        roles = [role for role in self._workers if role not in self.result.lost and role not in self._slots.empty]
        stalled = self.watchdog.longest_stall(roles) if self._wallclock else self.watchdog.stalled_for()
        stuck = [] if self._wallclock else self.watchdog.silent(self._patience.foreign & {*roles} - finished, limit_s)
        if stuck and self.watchdog.silent_for() < TUNING.silent_s:
            when = max(self.watchdog.progress[stuck[0]].tick, 0) / NS
            text = f"{', '.join(stuck)} blocks the run at {when:.3f} s: its step did not return within {limit_s:g} s"
            raise RunFailed(FailureCode.BLOCKED, f"{text} ({variable('step_limit_s')})", *stuck)
        if stalled > self._patience.hard:
            if (silent := self.watchdog.silent_for()) > TUNING.silent_s:
                text = f"transport lost: no report of any service for {silent:.0f} s; no service is at fault"
                raise RunFailed(FailureCode.TRANSPORT_LOST, text)
            role, text = self.watchdog.culprit(roles)
            raise RunFailed(FailureCode.BLOCKED, f"{role} blocks the run for {stalled:.0f} s: {text}", role)
        if stalled > self._patience.soft and not self._warned:
            reason = self.watchdog.culprit(roles)[1]
            self._notify(f"no tick for {stalled:.0f} s, waiting {self._patience.hard:.0f} s at most: {reason}")
        self._warned = stalled > self._patience.soft

    # -- lost services

    def _lose_frozen(self, finished: Container[str]) -> None:
        """Mark frozen services lost. In lockstep no other service can react without them, so the run ends."""
        for role, how in self._freezes.frozen().items():
            if role in finished or role in self.result.lost:
                continue
            self._keep_slot_or_lose(role, Failure(FailureCode.FROZEN, how))
            if not self._wallclock and not self._contract.roles[role].observer:
                failure = self.result.failure or Failure(FailureCode.FROZEN, how)
                raise RunFailed(failure.code, failure.text, *failure.roles)

    def _exited_roles(self, exited: Callable[[], Mapping[str, str]]) -> dict[str, str]:
        """Return the roles whose process or connection ended, with a text that says how."""
        ended = {role: how for role, how in exited().items() if role not in self._slots.replaced}
        gone = self._member.gone()
        texts = {role: self._freezes.connection_lost(role) for role in gone - self.result.lost.keys() - ended.keys()}
        if gone and self._member.transport_lost():  # checked last: services disappear before their router does
            text = f"transport lost at {self.watchdog.reached / NS:.3f} s: {TRANSPORT_LOST}; no service is at fault"
            raise RunFailed(FailureCode.TRANSPORT_LOST, text)
        return {**texts, **ended}

    def _keep_slot_or_lose(self, role: str, cause: Failure) -> None:
        """Keep the slot of a role that left, or mark the role lost."""
        if not self._slots.keeps(role) or role in self.result.lost:
            self._mark_lost(role, cause)
            return
        if self._slots.leave(role, cause.text):
            tick = max(self.watchdog.progress[role].tick, 0) / NS
            self._notify(f"{role} left at {tick:.3f} s: {cause}; its slot is kept for {self._slots.patience_s:.0f} s")
            self._subscriptions[role].hand_over()
            self._freezes.forget(role)
            self._send(RunControl.HANDOVER, role=role, reason=cause.text)

    def _mark_lost(self, role: str, cause: Failure) -> None:
        """Mark all roles of a process lost at their last reported tick, and let the others react."""
        if role in self.result.lost:
            return
        lost = self._process_roles[role]
        texts = []
        for one in lost:
            tick = max(self.watchdog.progress[one].tick, 0)
            self.result.lost[one] = tick
            texts.append(f"{one} lost at {tick / NS:.3f} s: {cause}")
        self.result.trouble += texts
        failure = Failure(cause.code, "; ".join(texts), tuple(dict.fromkeys((*lost, *cause.roles))), cause.topics)
        if self._contract.roles[role].observer:
            log.warning("%s; the run continues", failure)
            return
        self.result.failure = self.result.failure or failure
        if any(self._contract.roles[one].critical for one in lost):
            raise RunFailed(failure.code, failure.text, *failure.roles, topics=failure.topics)
        for one in lost:
            self._send(RunControl.LOST, self.result.lost[one], role=one, reason=cause.text)
        end = self.watchdog.reached // MS * MS + TUNING.after_loss_ns
        self.grants.grant(min(end, self.grants.horizon) if self.grants.last else end, last=True)

    def _collect_heartbeat_timeouts(self) -> None:
        """Record that services left while this conductor stood still, so that they are not blamed."""
        self._receive_reports()
        if self._heartbeat.stood_still_s and CONDUCTOR not in self.result.lost:
            tick = self.watchdog.progress[self._workers[0]].tick
            self._on_heartbeat_timeout("", tick, "the services left without it")

    def _on_heartbeat_timeout(self, role: str, tick: int, reason: str) -> None:
        """End the examination: the service `role`, if known, received no heartbeat of this conductor for the deadline."""
        if CONDUCTOR in self.result.lost:
            return
        self.result.lost[CONDUCTOR] = max(tick, 0)
        stood = f"; it stood still for {self._heartbeat.stood_still_s:.1f} s" if self._heartbeat.stood_still_s else ""
        reported = f"{role} reports: {reason}" if role else reason
        text = f"conductor lost at {max(tick, 0) / NS:.3f} s: {reported}{stood}"
        self._notify(text)
        self.result.failure = Failure(FailureCode.CONDUCTOR_LOST, text, (CONDUCTOR,))

    # -- the end

    def _store_report(self, role: str, detail: dict[str, Any]) -> None:
        self.result.blame[role] = detail.pop("blame", None)
        self.result.digests |= detail.pop("digests", {})
        self.result.counters[role] = detail

    def _end(self, exited: Callable[[], Mapping[str, str]], tell: Callable[[Conductor], None]) -> None:
        """Let the observers take in what is left and close their files."""
        waiting = set(self._observers) - self.result.lost.keys()
        begin, warned = perf_counter(), False
        self._send(RunControl.END)
        while waiting and perf_counter() - begin < TUNING.observers_finish_s:
            self._heartbeat.loop_turned()
            self._observed.drain_and_step()
            ended = exited()
            sleep(TUNING.poll_s)  # a process reports its end right before it exits
            for role, message, detail in self._receive_reports():
                if message.state == ServiceReport.FINISHED:
                    waiting.discard(role)
                    self._store_report(role, detail)
                    self._notify(*filter(None, [detail.get("facts", {}).get("trouble")]))
            for role in waiting & ended.keys():
                self._notify(f"{role} exited while closing: {ended[role]}")
            waiting -= ended.keys()
            if waiting and not warned and perf_counter() - begin > self._patience.quiet:
                roles = ", ".join(sorted(waiting))
                self._notify(f"waiting for {roles} to close the files, {TUNING.observers_finish_s:.0f} s at most")
                tell(self)
                warned = True
        for role in waiting:
            self._notify(f"{role} did not finish within {TUNING.observers_finish_s:.0f} s")


def conduct(
    session: zenoh.Session,
    roles: tuple[str, ...],
    tell: Tell,
    exited: Callable[[], Mapping[str, str]] = dict,
    timing: Timing | None = None,
    patience: Patience | None = None,
    begin: float | None = None,
    exam: ExamInput | None = None,
) -> RunResult:
    """Conduct services that are started elsewhere to the end of the run, and return its result.

    `exited` gives the roles whose process ended, with a text that says how; `begin` [s] is the time of the command by
    `perf_counter`. Without `exam` no `tf` is published, and samples are not counted.
    """
    begin = perf_counter() if begin is None else begin
    collector = Collector(tree=FrameTree(exam) if exam else None)
    conductor = Conductor(session, contract(), Settings.read().domain, roles, collector, patience, timing)

    def report(c: Conductor) -> None:
        wall = max(c.elapsed_s, 1e-9)
        t = max(collector.collected.exam_time, 0)
        tell(RunProgress(t, t / NS / wall, collector.collected, tuple(c.result.trouble), c.request if c.elapsed_s else None))

    result = conductor.result
    try:
        with rare_collections():
            conductor.run(exited, report)
        result.failure = result.failure or incomplete(collector.collected)
        result.failure = result.failure or (unsampled(collector.collected, exam.exam) if exam else None)
    except RunFailed as error:
        result.failure = error.failure
    result.start_time_s = (conductor.started_at or perf_counter()) - begin
    return result
