"""The conductor's heartbeat, and the progress of the services: which one blocks the others, which process is
frozen; and each topic against its row of the contract.

Frozen processes are found only where the conductor can inspect them: on the same machine, in the same namespace of process ids.

The contract's watch is outside the data path. Slow topics are received all the time. Each subscriber of a 1 kHz topic costs its
producer one message per tick, so fast topics are received one at a time, for `sample_s` every `round_s`; types, hashes and
senders of all topics follow from their liveliness tokens. `palpate doctor` receives everything at once.
"""

import os
from collections.abc import Callable, Collection, Container, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import cycle
from threading import Event, Thread
from time import monotonic, sleep
from typing import Any, Final, NamedTuple

import psutil
import zenoh

from palpate_bus.contract import CONDUCTOR, Contract
from palpate_bus.messages import NS, DiagnosticStatus, KeyValue, RunControl, codec
from palpate_bus.monitor.health import RECENT_S, SeenViolation, topic_statuses
from palpate_bus.monitor.monitor import LiveMonitor
from palpate_bus.runtime.conductor_link import CONTROL_TYPE, HEARTBEAT, longest_silence_s
from palpate_bus.runtime.member import Member
from palpate_bus.runtime.process import Activity, is_running, pid_space
from palpate_bus.security.access import list_watched
from palpate_conductor.outcome import Patience


class WatchdogTuning(NamedTuple):
    """Times after which silence means something."""

    hung_s: float = 2.0
    """Time after which a loop that has not turned counts as hanging."""
    recent_s: float = 2.0
    """Time after a standstill within which a loss may be its consequence."""
    check_period_s: float = 0.25
    exit_s: float = 0.05
    """A process that exits closes its connections this long before it is gone."""
    computing_s: float = 0.5
    """A service that is silent for longer is in a step; one that waits reports every 0.2 s."""


TUNING: Final = WatchdogTuning()

QOS: Final = "control"
"""A late beat is worse than a lost one, and a frozen reader must not delay the others' beats."""


class Heartbeat:
    """Sends beats from `start` to `stop`.

    A thread sends them, so that drawing a figure or decoding a message does not delay them. They stop while the conductor's loop
    hangs, since a conductor that hangs does not pass on an operator's stop.
    """

    def __init__(self, member: Member, contract: Contract, wallclock: bool) -> None:
        self._period_s = contract.internal[HEARTBEAT].period / NS
        self._deadline_s = longest_silence_s(contract, wallclock)
        self._publisher = member.internal_publisher(HEARTBEAT, CONTROL_TYPE, QOS)
        self._message = codec.encoder(CONTROL_TYPE)(RunControl(RunControl.HEARTBEAT, os.getpid(), False, "", pid_space()))
        self._turned_at = self._sent_at = monotonic()
        self._late_at = 0.0
        """When a beat was sent that came later than the services' deadline."""
        self._stop = Event()
        self._thread = Thread(target=self._run, name="heartbeat", daemon=True)
        self._stood_still_s = 0.0
        self._resumed_at = 0.0

    def start(self) -> None:
        """Start the thread."""
        self._turned_at = self._sent_at = monotonic()
        self._thread.start()

    def loop_turned(self) -> None:
        """Record that the conductor's loop makes progress."""
        now = monotonic()
        stood_still_s = now - self._turned_at
        late = now - self._sent_at > self._deadline_s or now - self._late_at < stood_still_s
        if stood_still_s > self._deadline_s and late:
            self._stood_still_s, self._resumed_at = stood_still_s, now
        self._turned_at = now

    @property
    def stood_still_s(self) -> float:
        """Duration [s] of a recent standstill of loop and heartbeat beyond the services' deadline; 0 without one."""
        return self._stood_still_s if monotonic() - self._resumed_at < TUNING.recent_s else 0.0

    def stop(self) -> None:
        """Stop the thread, if it was started."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join()

    def _run(self) -> None:
        sequence = 0
        while not self._stop.wait(self._period_s):
            now = monotonic()
            if now - self._turned_at <= TUNING.hung_s:
                self._late_at = now if now - self._sent_at > self._deadline_s else self._late_at
                self._sent_at = now
                sequence += 1
                self._publisher.put(self._message, sequence)


class FreezeWatch:
    """Inspects the services' processes. A slow process uses processor time or waits for a core; a frozen one does neither."""

    def __init__(self, patience: Patience) -> None:
        self._patience = patience
        self._activity: dict[str, Activity] = {}
        self._checked_at = 0.0

    def add(self, role: str, detail: Mapping[str, Any]) -> None:
        """Start to watch the process that a service names in its READY report."""
        if role not in self._activity and detail.get("home") == pid_space() != "":
            with suppress(psutil.Error):
                self._activity[role] = Activity(int(detail["pid"]))

    def forget(self, role: str) -> None:
        """End the watch over the process of `role`, which another one may replace."""
        self._activity.pop(role, None)

    def connection_lost(self, role: str) -> str:
        """Return a text for the closed connection of `role`, with the state of its process if that still runs."""
        activity = self._activity.get(role)
        if activity is not None and is_running(activity.pid):
            sleep(TUNING.exit_s)
            if is_running(activity.pid):
                reason = "the connection broke, or the machine is overloaded"
                return f"its connection closed, but its process {activity.pid} runs: {reason}"
        return "its connection closed"

    def frozen(self) -> dict[str, str]:
        """Return the roles of frozen processes with a text each: stopped ones, or if there is none, ones that sleep for long.

        A stopped process blocks others that send to it; these sleep without being at fault.
        """
        now = monotonic()
        if now - self._checked_at < TUNING.check_period_s:
            return {}
        self._checked_at = now
        states = {role: activity.check() for role, activity in self._activity.items()}
        stopped = {role: state for role, state in states.items() if state.stopped}
        limit = self._patience.frozen if stopped else self._patience.asleep
        text = "frozen: its process {0.pid} is {0.status} and has used no processor time for {0.seconds:.1f} s"
        return {role: text.format(state) for role, state in (stopped or states).items() if state.seconds >= limit}


@dataclass
class RoleProgress:
    """The last report of a service."""

    tick: int = -1
    """Last finished tick [ns]."""
    waiting_for: str = ""
    """Topic it waits for, `grant`, or empty."""
    reported: float = field(default_factory=monotonic)
    moved: float = field(default_factory=monotonic)
    """When it last reported a new tick, by the monotonic clock [s]."""


class RunWatchdog:
    """Keeps the progress of every service and finds the one that blocks the others."""

    def __init__(self, roles: tuple[str, ...], producers: dict[str, str]) -> None:
        """`producers` gives the producing role of each topic."""
        self.progress = {role: RoleProgress() for role in roles}
        self._producers = producers

    def report(self, role: str, tick: int, waiting_for: str) -> None:
        """Take a report."""
        progress, now = self.progress[role], monotonic()
        progress.reported, progress.waiting_for = now, waiting_for
        if tick > progress.tick:
            progress.tick, progress.moved = tick, now

    @property
    def reached(self) -> int:
        """The latest tick [ns] that any service has finished, 0 at least."""
        return max(0, *(progress.tick for progress in self.progress.values()))

    def silent_for(self) -> float:
        """Return the time [s] since the last report of any service; services that wait report, too."""
        return monotonic() - max(progress.reported for progress in self.progress.values())

    def silent(self, roles: Collection[str], limit_s: float) -> list[str]:
        """Return those of `roles` without a report for `limit_s` [s]. A service reports while it waits, not in its step."""
        return [role for role in roles if monotonic() - self.progress[role].reported > limit_s]

    def stalled_for(self) -> float:
        """Return the time [s] since any service finished a tick."""
        return monotonic() - max(progress.moved for progress in self.progress.values())

    def longest_stall(self, roles: Collection[str]) -> float:
        """Return the longest time [s] since one of `roles` finished a tick (wall-clock runs)."""
        return monotonic() - min((self.progress[role].moved for role in roles), default=monotonic())

    def restart(self, *roles: str) -> None:
        """Start to measure stalls of `roles`, by default of all, from now: at the first grant and while the run is paused."""
        for role in roles or self.progress:
            self.progress[role].moved = monotonic()

    def culprit(self, roles: Collection[str]) -> tuple[str, str]:
        """Return the one of `roles` that blocks the others, and a text.

        Follows who-waits-for-whom from the slowest waiting service to one that does not wait, or around a cycle.
        """
        computing = self.silent(roles, TUNING.computing_s)  # what they waited for before their step is past
        awaited = {role: self._producers.get(self.progress[role].waiting_for, "") for role in roles if role not in computing}
        waiting = {role: producer for role, producer in awaited.items() if producer in roles}
        if all(self.progress[role].waiting_for == "grant" for role in roles):
            return CONDUCTOR, "all services wait for a grant of the conductor: planning or the recorder is behind"
        if not waiting:
            role = min(roles, key=lambda name: self.progress[name].moved)
            return role, f"{role} has not finished a tick since {self.progress[role].tick / 1e9:.3f} s; no service waits for it"
        role = min(waiting, key=lambda name: self.progress[name].tick)
        path = [role]
        while path[-1] in waiting:
            follower = waiting[path[-1]]
            if follower in path:
                return follower, f"cycle of waiting services: {' -> '.join([*path[path.index(follower) :], follower])}"
            path.append(follower)
        culprit = path[-1]
        blocked = ", ".join(f"{name} (for {self.progress[name].waiting_for})" for name in sorted(set(waiting) - {culprit}))
        tick_s = self.progress[culprit].tick / 1e9
        return culprit, f"{culprit} is at {tick_s:.3f} s and does not wait; blocked: {blocked}"


class ContractWatchTuning(NamedTuple):
    """When the contract's topics are received."""

    poll_s: float = 0.2
    fast_ms: float = 10
    """Topics of a shorter period are received in turn."""
    sample_s: float = 1.5
    """Time that a rate needs to be judged, and a subscription to begin."""
    round_s: float = 12.0


WATCHING = ContractWatchTuning()


class ContractWatch:
    """Watches the bus of a run, whose wall-clock `rate` is None in lockstep. Call `poll` often."""

    def __init__(self, session: zenoh.Session, contract: Contract, domain: int, rate: float | None = None) -> None:
        topics = [contract.topics[name] for name in list_watched(contract)]
        received = [topic for topic in topics if topic.producer != CONDUCTOR or topic.open]  # without its own
        fast = [topic.name for topic in received if topic.periodic and topic.period_ms < WATCHING.fast_ms]
        self._slow = [topic.name for topic in received if topic.name not in fast]
        self._turns = cycle(fast)
        self._live = LiveMonitor(session, contract, domain, self._slow, rate)
        self._polled = self._round = monotonic()
        self._sampling = False

    def poll(self, *, force: bool = False) -> None:
        """Process what was received, at most every `poll_s` unless forced, and switch to the next fast topic when it is due."""
        now = monotonic()
        if now - self._polled < WATCHING.poll_s and not force:
            return
        self._polled = now
        self._live.poll()
        if not self._sampling and now - self._round >= WATCHING.round_s - WATCHING.sample_s:
            self._sampling, self._round = True, now
            self._live.listen([*self._slow, next(self._turns)])
        elif self._sampling and now - self._round >= WATCHING.sample_s:
            self._sampling, self._round = False, now
            self._live.listen(self._slow)

    def statuses(self) -> list[Any]:
        """Return a `diagnostic_msgs/DiagnosticStatus` of every topic."""
        monitor = self._live.monitor
        return topic_statuses(monitor.health(), monitor.active.values(), monotonic())

    def violations(self, sender: str) -> list[SeenViolation]:
        """Return the violations of a sender, the latest last."""
        found = (seen for seen in self._live.monitor.active.values() if seen.violation.sender == sender)
        return sorted(found, key=lambda seen: seen.last)

    def close(self) -> None:
        """Close the subscriptions."""
        self._live.close()


def service_statuses(
    progress: Mapping[str, RoleProgress],
    lost: Container[str],
    silent_s: float,
    violations: Callable[[str], Sequence[SeenViolation]],
) -> list[Any]:
    """Return a status per service: ERROR if it is lost or violates the contract, WARN if it has not reported for `silent_s` [s].

    `violations` gives those of a service so far, the latest last.
    """
    now = monotonic()
    statuses = []
    for role, at in progress.items():
        found = violations(role)
        level, message = _judge(at, role in lost, now - at.reported, silent_s, found, now)
        values = [KeyValue("tick_s", f"{at.tick / NS:.3f}"), KeyValue("waiting_for", at.waiting_for)]
        values.append(KeyValue("report_age_s", f"{now - at.reported:.2f}"))
        values.append(KeyValue("violations", str(sum(seen.count for seen in found))))
        statuses.append(DiagnosticStatus(level, f"palpate/{role}", message, role, values))
    return statuses


def _judge(
    at: RoleProgress, lost: bool, silent: float, silent_s: float, found: Sequence[SeenViolation], now: float
) -> tuple[int, str]:
    if lost:
        return DiagnosticStatus.ERROR, "lost"
    if found and now - found[-1].last <= RECENT_S:
        return DiagnosticStatus.ERROR, str(found[-1].violation)
    if silent > silent_s:
        return DiagnosticStatus.WARN, f"silent for {silent:.0f} s"
    return DiagnosticStatus.OK, f"waits for {at.waiting_for}" if at.waiting_for else "runs"
