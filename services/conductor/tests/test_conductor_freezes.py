"""How a service went whose connection is gone."""

from __future__ import annotations

import subprocess
import sys

from palpate_bus.runtime.process_state import home
from palpate_conductor.freezes import FreezeWatch
from palpate_conductor.outcome import Patience


def test_a_process_that_runs_without_a_connection_is_told_from_one_that_is_gone() -> None:
    child = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)
    watch = FreezeWatch(Patience())
    watch.meet("planning", {"pid": child.pid, "home": home()})
    assert f"its process {child.pid} runs" in watch.gone("planning")
    assert watch.gone("camera") == "its connection is gone"
    child.kill()
    child.wait()
    assert watch.gone("planning") == "its connection is gone"
