"""A viewer that joins a run which is on: what happened so far from the run's recording, what comes from the bus.

It is a node of its own beside the run's dashboard. It reads what is sent anyway, latest wins, and no service waits for it.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from time import monotonic, sleep

import zenoh

from palpate_bus.contract import contract
from palpate_bus.messages import RunControl, codec
from palpate_bus.runs.announcement import Run, live
from palpate_bus.runs.operator_keys import OperatorKeys
from palpate_bus.runs.operator_requests import order
from palpate_bus.runtime.member import Member
from palpate_bus.runtime.observer import IDLE_S, ObservedService
from palpate_bus.security.access import OPERATOR
from palpate_bus.wire.zenoh_config import session
from palpate_dashboard.replay import draw, messages, recording_of
from palpate_dashboard.service import DashboardService

CHECK_S = 1.0
"""How often it is looked whether the run is still announced."""
Say = Callable[[str], None]


def _operator(run: Run, bus: zenoh.Session) -> AbstractContextManager[zenoh.Session]:
    """How an operator's keys reach the run: a secure one does not take them from a viewer."""
    return nullcontext(bus) if run.keys is None else session(run.options(OPERATOR))


def follow(run: Run, service: DashboardService, say: Say, keys: OperatorKeys) -> str:
    """Draws `run` until it ends, and finishes `service`; passes on what an operator's `keys` say. Returns how it ended."""
    rules = contract()
    with session(run.options()) as bus, _operator(run, bus) as operator:
        member = Member(bus, f"viewer_{os.getpid()}", rules, run.domain)
        control = member.internal_subscription("palpate/control", "palpation_msgs/msg/RunControl")
        decode = codec.decoder("palpation_msgs/msg/RunControl")
        observed = ObservedService(service, member)  # listens from now on, while the past is drawn
        recording = recording_of(Path(run.out))
        if recording:
            say(f"drawing what happened so far, from {recording[0].parent}")
            until = draw(messages(recording), service)
            say(f"joined at {max(until, 0) / 1e9:.1f} s of simulated time")
        checked = monotonic()
        end = ""
        while not end:
            if not observed.drain_and_step():
                sleep(IDLE_S)
            for word in keys.pressed():
                say(order(operator, run.domain, word, "a key of palpate dashboard"))
            while (sample := control.get(0)) is not None:
                message = decode(sample.payload)
                if message.command == RunControl.END:
                    end = "the run is over"
                elif message.command == RunControl.ABORT:
                    end = f"the run was aborted: {message.reason}"
            if monotonic() - checked > CHECK_S:
                checked = monotonic()
                if all((other.pid, other.started) != (run.pid, run.started) for other in live()):
                    end = "the run is gone"
        observed.drain_and_step()
        service.flush()
        member.leave()
    return end
