"""Time until ports refuse each lie, without an examination per lie: recorded messages of a healthy run, changed by the liar.

    palpate run clean --composed --record full --out out/healthy
    python -m research.lies_at_ports out/healthy

Each case of `palpate faults --kind lie` in lockstep changes the messages of one second from its moment on. Prints, by topic, how
many cases the sender's port refuses, the longest time until then, and the others by kind. The second is that of the healthy run:
reactions of the arm to the lie are not in it.
"""

import sys
from collections import defaultdict
from pathlib import Path

from palpate_benchmarks.liar import Lie, LyingTopic
from palpate_benchmarks.lies import LIES, MOMENTS, cases, moments_of
from palpate_bus.contract import contract
from palpate_bus.contract.port_check import PortCheck, RefusedMessage
from palpate_bus.messages import NS, Message
from palpate_bus.messages.codec import decoder
from palpate_bus.recordings import Recording, open_recording


def refused_after(lie: Lie, sent: dict[str, list[tuple[int, Message]]]) -> float | None:
    """Return the time [ms] until a port refuses a message of the lie; None if none does."""
    found = []
    for name in lie.topics:
        row = contract().topics[name]
        lying, check = LyingTopic(lie._replace(topic=name)), PortCheck(row, sends=True)
        try:
            for t, message in sent[name]:
                for changed in lying.messages(t, [message], row.event):
                    check(changed, t)
        except RefusedMessage:
            found.append((t - lie.at_s * NS) / 1e6)
    return min(found, default=None)


def window(recording: Recording, at_s: float) -> dict[str, list[tuple[int, Message]]]:
    """Return the messages of all topics from shortly before a moment until a second after it, with their times [ns]."""
    rows = contract().topics
    sent: dict[str, list[tuple[int, Message]]] = defaultdict(list)
    begin, end = round((at_s - LIES.before_s) * NS), round(at_s * NS) + NS
    for recorded in recording.messages([name for name, row in rows.items() if not row.latched], begin, end):
        sent[recorded.topic].append((recorded.stamp, decoder(rows[recorded.topic].type)(recorded.payload)))
    return sent


def main(folder: Path) -> None:
    """Print the table of a recording."""
    recording = open_recording(folder)
    decode = decoder(contract().topics["exam/state"].type)
    moments = moments_of([decode(recorded.payload) for recorded in recording.messages(["exam/state"])])
    after: dict[tuple[str, str], list[float | None]] = defaultdict(list)
    windows = {moment: window(recording, moments[moment]) for moment in MOMENTS}
    for case in cases(("lockstep",), ()):
        topic, path, kind, amount, moment = case.target.split()
        lie = Lie(topic, path, kind, float(amount), moments[moment])
        if windows[moment][topic]:
            after[topic, kind].append(refused_after(lie, windows[moment]))
    print("| topic | cases | refused | longest [ms] | not refused: kinds |\n|---|---|---|---|---|")
    for topic in dict.fromkeys(topic for topic, _ in after):
        mine = {kind: times for (name, kind), times in after.items() if name == topic}
        every = [time for times in mine.values() for time in times]
        caught = [time for time in every if time is not None]
        passed = [f"{kind} {times.count(None)}" for kind, times in mine.items() if None in times]
        print(f"| {topic} | {len(every)} | {len(caught)} | {max(caught, default=0.0):.0f} | {', '.join(passed)} |")
    every = [time for times in after.values() for time in times]
    print(f"\n{sum(time is not None for time in every)} of {len(every)} cases refused at the sender's port")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
