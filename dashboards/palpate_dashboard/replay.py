"""Draws a run from the recorder's MCAP file, finished or live.

`main` writes DIR/recording.rrd from DIR/recording_mcap and DIR/scenario.yaml.
`follow` draws a live run: its past from the recording, then live messages. It is a separate node; no service waits for it.
"""

import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, closing, nullcontext
from functools import partial
from heapq import heappop, heappush
from itertools import groupby
from pathlib import Path
from time import monotonic, sleep

import zenoh
from mcap.reader import make_reader
from mcap.records import Channel, Message as McapMessage, Schema

from palpate_bus.contract import Topic, contract
from palpate_bus.mcap_records import BROKEN, RecordingError, complete_records
from palpate_bus.messages import NS, RunControl, codec
from palpate_bus.recordings import recorded_type
from palpate_bus.runs.announcement import Run, live_runs
from palpate_bus.runs.operator import OperatorKeys, order
from palpate_bus.runtime.lockstep import Packet, Stepper
from palpate_bus.runtime.member import Member
from palpate_bus.runtime.observer import LIMITS, ObservedService
from palpate_bus.security.access import OPERATOR
from palpate_bus.settings import RECORDING
from palpate_bus.wire.zenoh_config import session
from palpate_dashboard.service import DashboardService
from palpate_dashboard.sinks import Live
from palpate_inputs import InputFile
from palpate_models.scenario.load import load_scenario

DISORDER_MAX_NS = 2_000_000_000
"""A later message may be earlier than one before it by this [ns]."""


def recording_of(folder: Path) -> tuple[Path, ...]:
    """Return the MCAP files of the run in `folder`, in order; a long recording has several.

    Without a recording, as of an assessed recording of another robot, it is the file of its results.
    """
    files = sorted((folder / RECORDING).glob(f"{RECORDING}_*.mcap"), key=lambda path: int(path.stem.rpartition("_")[2]))
    return tuple(files) or tuple(folder.glob("evidence.mcap"))


def end_of(files: Sequence[Path]) -> int | None:
    """Return the time of the last message [ns]; None if the last file is incomplete. Raises OSError."""
    with InputFile(files[-1], RecordingError) as stream:
        try:
            summary = make_reader(stream).get_summary()
        except BROKEN:
            return None
    return None if summary is None or summary.statistics is None else summary.statistics.message_end_time


def messages(files: Sequence[Path]) -> Iterator[tuple[int, str, bytes]]:
    """Yield time [ns], topic and payload of all complete messages on observed topics, ordered by time.

    The last file may still be written or be truncated. Services send messages in chunks, so order is restored within
    `DISORDER_MAX_NS`. Raises OSError, RecordingError for greater disorder or a topic of another type than the contract's.
    """
    topics = {f"/{topic.name}": topic for topic, _ in contract().inputs("dashboard")}
    waiting: list[tuple[int, int, str, bytes]] = []
    past = 0
    for count, (name, record) in enumerate(_records(files, topics)):
        if record.log_time < past:
            late = f"{name} of {record.log_time / NS:.3f} s stands after {past / NS + DISORDER_MAX_NS / NS:.3f} s"
            raise RecordingError(f"{files[0].parent}: {late} (expected at most {DISORDER_MAX_NS / NS:g} s of disorder)")
        heappush(waiting, (record.log_time, count, name, record.data))
        while waiting[0][0] < record.log_time - DISORDER_MAX_NS:
            past, _, topic, payload = heappop(waiting)
            yield past, topic, payload
    while waiting:
        time, _, topic, payload = heappop(waiting)
        yield time, topic, payload


def _records(files: Sequence[Path], topics: Mapping[str, Topic]) -> Iterator[tuple[str, McapMessage]]:
    for path in files:
        names: dict[int, str] = {}
        schemas: dict[int, Schema] = {}
        for record in complete_records(path):
            if isinstance(record, Schema):
                schemas[record.id] = record
            elif isinstance(record, Channel) and record.topic in topics and record.schema_id in schemas:
                difference = recorded_type(record, schemas[record.schema_id]).difference(topics[record.topic])
                if difference:
                    raise RecordingError(f"{path}: topic {record.topic[1:]} was recorded {difference}; record again")
                names[record.id] = record.topic.removeprefix("/")
            elif isinstance(record, McapMessage) and record.channel_id in names:
                yield names[record.channel_id], record


def draw(
    source: Iterable[tuple[int, str, bytes]], service: DashboardService, progress: Callable[[int], None] | None = None
) -> int:
    """Step `service` through time-ordered messages at its period; return the last time [ns], -1 without messages.

    `progress` receives the simulated time [ns].
    """
    period = contract().roles[service.role].period
    stepper = Stepper(service, contract())
    last = -1
    for tick, group in groupby(source, key=lambda item: -(-item[0] // period)):
        for stamp, topic, payload in group:
            stepper.buffers[topic].deliver(Packet(payload, stamp, 0, checked=True))
        last = tick * period
        stepper.step(last)
        if progress is not None:
            progress(last)
    return last


def replay(files: Sequence[Path], scenario: Path, target: Path, progress: Callable[[int], None] | None = None) -> Path:
    """Draw the recording of a run with the file `scenario` into the file `target`, which is returned. Raises OSError."""
    service = DashboardService(load_scenario(str(scenario)), target, Live(), paced=False)
    try:
        draw(messages(files), service, progress)
        service.finish()
    except BaseException:
        target.unlink(missing_ok=True)  # a partial file would pass for a complete one
        raise
    return target


CHECK_S = 1.0
"""Interval of checking that the run is still announced."""


def _operator(run: Run, bus: zenoh.Session) -> AbstractContextManager[zenoh.Session]:
    """Return the session that carries operator requests: in a secure run it has the operator's certificate."""
    return nullcontext(bus) if run.keys is None else session(run.options(OPERATOR))


def follow(run: Run, service: DashboardService, report: Callable[[str], None], keys: OperatorKeys) -> str:
    """Draw `run` until it ends, and forward operator `keys`. Returns how the run ended."""
    key, member_of = run.read_key(), partial(Member, role=f"viewer_{os.getpid()}", contract=contract(), domain=run.domain)
    with session(run.options()) as bus, _operator(run, bus) as operator, closing(member_of(bus)) as member:
        control = member.internal_subscription("palpate/control", "palpation_msgs/msg/RunControl")
        decode = codec.decoder("palpation_msgs/msg/RunControl")
        observed = ObservedService(service, member)  # collects live messages while the past is drawn
        recording = recording_of(Path(run.out))
        if recording:
            report(f"drawing the run's recording from {recording[0].parent}")
            until = draw(messages(recording), service)
            report(f"joined at {max(until, 0) / 1e9:.1f} s of simulated time")
        checked = monotonic()
        end = ""
        while not end:
            if not observed.drain_and_step():
                sleep(LIMITS.idle_s)
            for word in keys.read_requests():
                report(order(operator, run.domain, word, "a key of palpate dashboard", key))
            while (sample := control.get(0)) is not None:
                message = decode(sample.payload)
                if message.command == RunControl.END:
                    end = "the run has ended"
                elif message.command == RunControl.ABORT:
                    end = f"the run was aborted: {message.reason}"
            if monotonic() - checked > CHECK_S:
                checked = monotonic()
                if all((other.pid, other.started) != (run.pid, run.started) for other in live_runs()):
                    end = "the run disappeared"
        observed.drain_and_step()
        service.flush()
    return end
