"""`palpate run` in a terminal: its keys are passed on as an operator's requests, and what comes of them is shown."""

from __future__ import annotations

import os
import pty
import sys

PROGRAM = """
import sys, time
from types import SimpleNamespace
from palpate_bus.messages import OperatorRequest
from palpate_conductor.collector import Collected
from palpate.run.progress import RunDisplay
from palpate_conductor.outcome import RunProgress
from palpate_models.scenario.schema import Exam
from rich.console import Console

collected, asked = Collected(), []
def request(number, reason):
    asked.append(number)
    stops = number in (OperatorRequest.STOP, OperatorRequest.SOFT_STOP)
    collected.supervisor = SimpleNamespace(level=int(stops), reason="an operator" if stops else "")
with RunDisplay(Console(stderr=True, width=200), False, Exam()) as display:
    while len(asked) < 3:
        display.show(RunProgress(0, 1.0, collected, (), request))
        time.sleep(0.01)
print("asked", asked, [OperatorRequest.SOFT_STOP, OperatorRequest.STOP, OperatorRequest.RELEASE], flush=True)
"""


def test_keys_of_palpate_run() -> None:
    child, end = pty.fork()
    if child == 0:
        os.execv(sys.executable, [sys.executable, "-c", PROGRAM])
    text, sent = "", 0
    while True:
        try:
            text += os.read(end, 4096).decode(errors="ignore")
        except OSError:  # the terminal closes with its process
            break
        if "keys: s soft stop" in text and sent == text.count("stop: passed on"):
            os.write(end, b"ser"[sent : sent + 1])
            sent += 1
    _, status = os.waitpid(child, 0)
    os.close(end)
    assert status == 0, text
    asked, wanted = text.split("asked ")[1].split("] ")
    assert asked.strip("[ \r\n") == wanted.strip("[] \r\n")
    assert "stopped: an operator" in text
