"""Campaign of lies: one short examination per lie of a service (`liar`), against its twin without the lie.

Cases are made from the contract: each topic that a service reads, each field with a unit or a code, each kind of lie that fits
it, at rest, in descent, at depth and in transfer; `left_out` has the other topics and fields. A case is good if the lie was sent,
the true force kept its limit, the examination did not call itself complete on less than its twin felt, and the liar was named, or
did no harm, or sends what no other input contradicts (`UNDETECTABLE`).
"""

from collections.abc import Iterator, Mapping, Sequence
from itertools import cycle
from pathlib import Path
from random import Random
from time import monotonic
from typing import Any, Final, NamedTuple

from palpate.apart import run_guarded
from palpate.environment import set_environment
from palpate.run.composed import load_services
from palpate.run.distributed import run_distributed
from palpate.run.roles import WORKERS, workers
from palpate_benchmarks import liar
from palpate_benchmarks.campaign import enter
from palpate_benchmarks.fault_cases import LIE, LIMITS, CaseOutcome, CaseResult, FaultCase
from palpate_benchmarks.injection import FaultLog, examination, logged, signs_of, sustained_rate
from palpate_benchmarks.liar import INJECTED, WHOLE, Lie
from palpate_bus.contract import Edge, Topic, contract
from palpate_bus.messages import MS, NS, ExamState, nanoseconds
from palpate_bus.messages.codec import leaves
from palpate_bus.runtime.composed import Composed, ServiceFailed
from palpate_bus.runtime.failure import Failure, FailureCode
from palpate_conductor.collector import Collected, Collector, FrameTree
from palpate_conductor.outcome import RunProgress, RunResult, Timing, incomplete, unsampled
from palpate_errors import RunError
from palpate_models.scenario.load import exam_input

MOMENTS: Final = ("rest", "descent", "depth", "transfer")
BEFORE_STROKES: Final = {
    "tf_static": 1, "planning/camera_trigger": 1, "camera/depth/image_raw": 2, "camera/depth/camera_info": 2,
    "perception/surface": 1, "perception/targets": 1,
}  # fmt: skip
"""Number of messages of the topics that are sent before the first stroke alone: they lie from rest on."""
SENT: Final = {**BEFORE_STROKES, "exam/correction": 1, "assessment/findings": 1}
"""Number of messages of the topics that are sent rarely."""
NEEDED: Final = {"frozen": 2, "delayed": 2, "repeated": 2, "disordered": 3}
"""Number of messages without which a lie changes none."""
SENSED: Final = ("ft/wrench", "joint_states", "robot/status", "control/joint_torque", "planning/setpoint", "sim/contact_wrench")
"""Topics that lie at every moment; the others at one of them in turn."""
_HELD: Final = (("frozen", 0.0), ("zero", 0.0))
CODES: Final[Mapping[str, Sequence[tuple[str, float]]]] = {
    **dict.fromkeys(("phase", "mode", "target_index", "in_contact", "steady", "final", "end_tick"), _HELD),
    **dict.fromkeys(("level", "state", "cause"), (("bias", 1.0), ("bias", 2.0))),
}
"""Fields without a scale that readers act on, and their lies; level, state and cause are 0 in an examination without a lie."""
OBEYED: Final = (
    ("perception/targets", "lines", "zero", 0.0),
    ("planning/camera_trigger", "frames", "zero", 0.0),
    ("planning/setpoint", "valid_for", "zero", 0.0),
    ("control/joint_torque", "valid_for", "zero", 0.0),
    ("exam/state", "stroke", "zero", 0.0),
    ("exam/state", "force_limited", "bias", 1.0),
    ("exam/state", "patient_moved", "bias", 1.0),
    ("supervisor/state", "releases", "bias", 1.0),
)
"""Further fields that readers act on, each with one lie."""
CONSTANT: Final = frozenset({"k", "radius", "stiffness", "damping_ratio"})
"""Fields that are the same in every message of the examination."""
JOINTS: Final = frozenset({"position", "velocity", "effort", "applied_torque", "torque", "joint_position", "joint_velocity"})
"""Fields with a number per joint."""
AMOUNTS: Final = {"N": 5.0, "N m": 0.5, "rad": 0.05, "rad/s": 0.2, "m": 0.03, "m/s": 0.1, "1": 0.3, "px": 20.0, "N/m": 500.0}
"""Bias by unit, a tenth of it per second for a drift, four times for a spike."""
NOISE: Final = {"N": 0.05, "N m": 0.002, "rad": 1e-6, "rad/s": 1e-4, "m": 0.002}
"""Noise of a live sensor by unit, standard deviation; `noise` adds twenty times as much."""
FACTORS: Final = {"gain": 0.3, "unnormalised": 1.5, "delayed": 100.0, "stale": 0.5}
DELAYS_MS: Final = (20, 50, 200)
LIVE_KINDS: Final = ("zero", "stale")
"""Further kinds of the cases in wall-clock mode."""


class LieTuning(NamedTuple):
    """Times of a lie's case, and limits of its outcome."""

    rest_s: float = 0.3
    """Simulated time at rest; the camera burst is triggered at 0.4 s."""
    min_share: float = 0.9
    """Share of the twin's targets that a complete examination has felt."""
    same_background: float = 0.25
    """Relative change of the map's background that counts as harm."""
    longest_ns: int = 180 * NS
    """Simulated time after which a case has hung."""
    case_s: float = 900.0
    """Maximum wall time of a case."""
    before_s: float = 0.25
    """A case of old messages is forked this long before its lie, so that the liar has some."""


LIES: Final = LieTuning()
LEFT_OUT: Final = {
    "only a search reads it": ("assessment/samples",),
    "planning reads only whether they are final": ("assessment/findings findings", "assessment/findings candidates"),
    "compared with the image, or not read": ("camera/",),
    "only observers read it": (
        "robot/status commands_rejected", "sim/surface normals", "sim/surface breathing", "perception/surface triangles",
        "perception/targets frames_fused", "exam/state target_count", "exam/state targets_skipped", "exam/state view_blocked",
        "exam/state reason", "supervisor/state refusals",
    ),
    "read only without targets": ("perception/targets reason",),
    "constant": ("sim/surface triangles",),
}  # fmt: skip
"""Reasons why topics, and fields that have neither unit nor code, have no cases; by how `topic field` begins."""
_STATE = "the simulation's own state, which hardware does not send"
UNDETECTABLE: Final = (
    ("sim/tool_state", "", _STATE),
    ("sim/link_poses", "", _STATE),
    ("sim/surface", "", _STATE),
    ("sim/contact_wrench", "", "the force on the arm in truth: sensor and joints feel it"),
    ("robot/status position", "drift bias delayed", "contradicts only joint_states, which its readers do not have"),
    ("robot/status velocity", "drift bias delayed gain", "contradicts only joint_states, which its readers do not have"),
)
"""Lies that no other input contradicts: topic or topic and field, kinds (empty: all), and the reason."""


class Healthy(NamedTuple):
    """The twin: the same examination without a lie."""

    moments_s: dict[str, float]
    felt: int
    """Number of targets."""
    findings: int
    background: float
    """Background of the map [N]."""
    length_s: float


def cells() -> Iterator[tuple[Topic, str, str, float]]:
    """Yield topic, field, kind and amount of every lie that fits the contract."""
    for topic in contract().topics.values():
        if without_cases(topic):
            continue
        for path in _paths(topic):
            yield from ((topic, path, kind, amount) for kind, amount in _kinds(topic, path))
        if topic.name == "perception/motion":
            yield from ((topic, "displacement,forecast", kind, FACTORS.get(kind, 0.0)) for kind in ("sign", "gain", "zero"))
        if not topic.latched:
            yield from ((topic, WHOLE, "late", float(delay)) for delay in DELAYS_MS)
            stamped = any(leaf.path.startswith("header.") for leaf in leaves(topic.type))
            kinds = ("repeated", "disordered", *(("stale",) if stamped else ()))
            yield from ((topic, WHOLE, kind, FACTORS.get(kind, 0.0)) for kind in kinds)
    yield from ((contract().topics[name], path, kind, amount) for name, path, kind, amount in OBEYED)


def _changes_a_message(topic: Topic, path: str, kind: str, amount: float) -> bool:
    """Return False for a lie that changes no message of the examination, or is that of a shorter delay."""
    if kind == "late":
        return amount in {-(-delay // topic.period_ms): delay for delay in reversed(DELAYS_MS)}.values()
    if path in CONSTANT and kind in ("frozen", "delayed"):
        return False
    return NEEDED.get(kind, 1) <= SENT.get(topic.name, 3)


def without_cases(topic: Topic) -> str:
    """Return why a topic has no cases; empty if it has."""
    if topic.producer not in WORKERS:
        return "its sender takes part in some runs only, or observes"
    if topic.name not in liar.TWINS and not any(edge.blocking or edge is Edge.LATCHED for edge in topic.readers.values()):
        return "no service reads it"
    return next((reason for reason, begins in LEFT_OUT.items() if topic.name in begins), "")


def left_out() -> dict[str, str]:
    """Return why topics and fields (`topic field`) have no cases. The liar changes no texts; stamps change with their message."""
    lying = {f"{topic.name} {one}." for topic, path, *_ in cells() for one in path.split(",")}
    out = {}
    for topic in contract().topics.values():
        if why := without_cases(topic):
            out[topic.name] = why
            continue
        for leaf in leaves(topic.type):
            covered = f"{topic.name} {leaf.path}.".startswith(tuple(lying))
            if not covered and leaf.base != "string" and "header." not in leaf.path:
                said = f"{topic.name} {leaf.path.split('.')[0]}"
                out[said] = next((reason for reason, begins in LEFT_OUT.items() if said.startswith(begins)), "")
    return out


def _paths(topic: Topic) -> Iterator[str]:
    """Yield the fields that have a unit, are quaternions or have a code; of findings those with a code."""
    paths = [leaf.path for leaf in leaves(topic.type)]
    quaternions = dict.fromkeys(path[:-2] for path in paths if path.endswith(("orientation.w", "rotation.w")))
    codes = (path for path in paths if path in CODES and path not in topic.units)
    yield from (*(() if topic.name == "assessment/findings" else topic.units), *quaternions, *codes)


def _kinds(topic: Topic, path: str) -> Iterator[tuple[str, float]]:
    if path.endswith(("orientation", "rotation")):
        yield from (("frozen", 0.0), ("nan", 0.0), ("swapped", 0.0), ("unnormalised", FACTORS["unnormalised"]))
        return
    if path in CODES:
        yield from CODES[path]
        return
    bias = AMOUNTS.get(topic.units[path].split(",")[0], 0.3)
    yield from (("zero", 0.0), ("nan", 0.0), ("infinite", 0.0), ("gain", FACTORS["gain"]), ("sign", 0.0), ("bias", bias))
    if not topic.latched:
        yield from (("drift", bias / 10), ("spike", 4 * bias), ("delayed", FACTORS["delayed"]), ("frozen", 0.0))
    if path in topic.varies:
        live = NOISE[topic.units[path]]
        yield from (("noise", 20 * live), ("dead", live), ("stuck", live))
    if path in JOINTS:
        yield "permuted", 0.0


def cases(modes: Sequence[str], only: Sequence[str]) -> Iterator[FaultCase]:
    """Yield lockstep cases: one per topic and kind, then other fields, then other moments; and those in wall-clock mode.

    `only` restricts them to topics, roles, kinds and moments.
    """
    turn = cycle(MOMENTS)
    ranked: list[tuple[int, Topic, str, str]] = []
    seen: set[tuple[str, str]] = set()
    for topic, path, kind, amount in cells():
        moments = ["rest"] if topic.name in BEFORE_STROKES else [next(turn)]
        if not _changes_a_message(topic, path, kind, amount):
            continue  # after its turn, so that the other cases keep their moments
        if topic.name in SENSED:
            moments += [moment for moment in MOMENTS if moment not in moments]
        for k, moment in enumerate(moments):
            rank = 2 if k else int((topic.name, kind) in seen)
            ranked.append((rank, topic, kind, f"{topic.name} {path} {kind} {amount:g} {moment}"))
        seen.add((topic.name, kind))
    for _, topic, kind, target in sorted(ranked, key=lambda case: case[0]):
        moment = target.split()[-1]
        if only and not {topic.name, topic.producer, kind, moment} & set(only):
            continue
        if "lockstep" in modes:
            yield FaultCase(LIE, target, wallclock=False)
        live = kind in ("frozen", "repeated") or (topic.name in SENSED and kind in LIVE_KINDS)
        if "wallclock" in modes and live and moment == "depth":
            yield FaultCase(LIE, target, wallclock=True)


def draw_lies(count: int, seed: int, modes: Sequence[str]) -> Iterator[FaultCase]:
    """Yield `count` random lies: a cell, an amount of 0.1 to 3 times its own, and a share of the twin's time.

    A topic that is sent before the strokes alone lies from rest on.
    """
    draw, known = Random(seed), [cell for cell in cells() if _changes_a_message(*cell)]
    for _ in range(count):
        topic, path, kind, amount = draw.choice(known)
        amount = float(f"{amount * 10 ** draw.uniform(-1, 0.5):.2g}")
        share = f"{draw.uniform(0, 0.9):.3f}"
        target = f"{topic.name} {path} {kind} {amount:g} {'rest' if topic.name in BEFORE_STROKES else share}"
        yield FaultCase(LIE, target, draw.choice(modes) == "wallclock")


def lie_of(target: str, healthy: Healthy) -> Lie:
    """Return the lie of a case: the moment is a name, or a share of the twin's simulated time."""
    topic, path, kind, amount, moment = target.split()
    at_s = healthy.moments_s.get(moment)
    return Lie(topic, path, kind, float(amount), float(moment) * healthy.length_s if at_s is None else at_s)


def start_s(lie: Lie) -> float:
    """Return the simulated time at which a case is forked; latched messages are sent before any."""
    if contract().topics[lie.topic].latched:
        return 0.0
    return max(lie.at_s - (LIES.before_s if lie.kind in liar.OLDER_KINDS else 0.0), 0.0)


def undetectable(lie: Lie) -> str:
    """Return why no other input contradicts the lie; empty if one does."""
    said = f"{lie.topic} {lie.field}"
    found = (why for what, kinds, why in UNDETECTABLE if said.startswith(what) and (not kinds or lie.kind in kinds.split()))
    return next(found, "")


class Lockstep:
    """One examination without a lie, from which the cases are forked at their moments: all share what came before."""

    def __init__(self, settings: Sequence[str]) -> None:
        scenario = examination(settings)
        self._exam = scenario.exam
        self._collector = Collector(tree=FrameTree(exam_input(scenario)))
        self._run = Composed([*load_services(scenario, workers(scenario)), self._collector])
        self.twin = run_guarded("the examination without a lie", lambda: healthy(self._finished(None).result), LIES.case_s)

    def judged(self, result: CaseResult, lie: Lie) -> CaseResult:
        """Return the result, judged by an examination with the lie; the times of the lies must not decrease."""
        start = round(start_s(lie) * 1e3) * MS
        if start > self._run.t:
            self._run.run(lambda: None, start - MS)
        try:
            return run_guarded(str(lie), lambda: judge(result, lie, self._finished(lie), self.twin), LIES.case_s)
        except RunError as error:  # one case must not end the campaign
            result.hung, result.outcome, result.ended = True, CaseOutcome.ENDED, str(error)
            return result

    def _finished(self, lie: Lie | None) -> FaultLog:
        """Run to the end, in a child process."""
        run, collected = self._run, self._collector.collected
        log = FaultLog(RunResult("composed", collected))

        def on_sent() -> None:
            log.sent = True

        if lie is not None:
            stepper = run.steppers[lie.role]
            stepper.service = liar.Liar(stepper.service, lie, on_sent)

        def end() -> int | None:
            if lie is not None and run.t >= lie.at_s * NS and not run.t % (10 * MS):
                log.add(RunProgress(run.t, 1.0, collected), run.t / 1e6 - lie.at_s * 1e3)
            return collected.end_tick

        failure: Failure | None
        try:
            run.run(end, LIES.longest_ns)
            failure = incomplete(collected) or unsampled(collected, self._exam)
        except ServiceFailed as error:
            failure = error.failure
        log.result = RunResult("composed", collected, sim_time_s=run.t / NS, failure=failure)
        return log


def by_wall_clock(lie: Lie, folder: Path, settings: Sequence[str]) -> FaultLog:
    """Return an examination with a lie in wall-clock mode, at the rate that this machine keeps."""
    log = FaultLog(RunResult("wallclock", Collected()))

    def on_progress(progress: RunProgress) -> None:
        if progress.t >= lie.at_s * NS:
            log.add(progress, progress.t / 1e6 - lie.at_s * 1e3)
        else:
            log.before = signs_of(progress)

    with set_environment({liar.VARIABLE: str(lie)}):
        scenario = examination((*settings, f"services.{lie.role}={liar.__file__}"))
        timing = Timing(wallclock=True, rate=sustained_rate(), limit=LIES.longest_ns)
        log.result = run_distributed(scenario, folder, on_progress, (), timing)
    if log.result.interrupted:
        raise KeyboardInterrupt  # ends the campaign, not the case alone
    log.sent = bool(logged(folder, INJECTED))
    return log


def healthy(result: RunResult) -> Healthy:
    """Return the figures of the run without a lie. Raises RunError if the run failed."""
    if result.failure is not None:
        raise RunError(f"the examination without a lie failed: {result.failure}")
    states = result.collected.exam_states
    felt, findings, background = _felt(result.collected)
    return Healthy(moments_of(states), felt, findings, background, nanoseconds(states[-1].header.stamp) / NS)


def moments_of(exam_states: Sequence[Any]) -> dict[str, float]:
    """Return the simulated times of the moments [s]."""
    states = [(nanoseconds(state.header.stamp) / NS, state) for state in exam_states]

    def begin(phase: int) -> float:
        return next(t for t, state in states if state.phase == phase)

    touched = next(t for t, state in states if state.in_contact)
    return {
        "rest": LIES.rest_s,
        "descent": (begin(ExamState.PHASE_INDENT) + touched) / 2,
        "depth": begin(ExamState.PHASE_SCAN) + LIMITS.at_depth_s,
        "transfer": begin(ExamState.PHASE_RETRACT) + LIMITS.at_depth_s,
    }


def _felt(c: Collected) -> tuple[int, int, float]:
    """Return the number of targets felt, of findings, and the background of the map [N]."""
    felt = 0 if c.exam is None else int(c.exam.target_count - c.exam.targets_skipped)
    background = 0.0 if c.stiffness_map is None else float(c.stiffness_map.background)
    return felt, 0 if c.findings is None else len(c.findings.findings), background


def run_lies(todo: Sequence[FaultCase], folder: Path, settings: Sequence[str] = ()) -> Iterator[CaseResult]:
    """Yield the results of the cases, those in lockstep in the order of their times."""
    lockstep = Lockstep(settings)
    twin = lockstep.twin
    for case in sorted(todo, key=lambda case: (case.wallclock, start_s(lie_of(case.target, twin)))):
        begin, lie = monotonic(), lie_of(case.target, twin)
        result = case.result()
        result.injected_s = round(lie.at_s, 3)
        if case.wallclock:
            result = judge(result, lie, by_wall_clock(lie, (folder / case.name).resolve(), settings), twin)
        else:
            result = lockstep.judged(result, lie)
        result.wall_s = round(monotonic() - begin, 1)
        yield result


def judge(result: CaseResult, lie: Lie, log: FaultLog, twin: Healthy) -> CaseResult:
    """Return the result with forces, signs and outcome."""
    collected, failure = log.result.collected, log.result.failure
    result.hung = failure is not None and failure.code is FailureCode.UNENDED
    felt, findings, background = _felt(collected)
    if failure is not None:
        result.ended = str(failure)
    elif felt < LIES.min_share * twin.felt:
        message = collected.exam.message if collected.exam else ""
        result.ended = f"without a failure, {felt} of {twin.felt} targets felt: {message}"
    elif findings == twin.findings and abs(background - twin.background) <= LIES.same_background * twin.background:
        result.outcome, result.ended = CaseOutcome.CONTINUED, "complete, as without the lie"
    else:
        result.ended = f"complete, background {background:.2f} N, without the lie {twin.background:.2f} N"
    if failure is not None and log.detected_ms is None:
        log.detected_ms = round((log.result.sim_time_s - lie.at_s) * 1e3, 1)
    enter(result, log, lie.topics, lie.at_s * NS)
    if not result.named and (reason := undetectable(lie)):
        result.named, result.undetectable, result.sign = True, True, f"not detectable: {reason}"
    if not log.sent:
        result.injected_s, result.ended = None, f"the lie was not sent: no message was changed; {result.ended}"
    return result
