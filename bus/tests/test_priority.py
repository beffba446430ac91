"""Who gives way."""

from __future__ import annotations

import os
import subprocess
import sys

from palpate_bus.contract import contract
from palpate_bus.run import in_background

PROGRAM = """
import os, sys, threading, time
from palpate_bus.runtime.process import BACKGROUND_NICENESS, run_in_background
run_in_background()  # elsewhere than on Linux it lowers the priority at most
after = threading.Thread(target=time.sleep, args=(30,), daemon=True)
after.start()
for thread in (0, after.native_id) if sys.platform == "linux" else ():
    assert os.sched_getscheduler(thread) == os.SCHED_BATCH
    assert os.getpriority(os.PRIO_PROCESS, thread) == min(int(os.environ["HERE"]) + BACKGROUND_NICENESS, 19)
"""


def test_a_service_goes_behind_others_with_the_threads_that_it_starts() -> None:
    here = os.getpriority(os.PRIO_PROCESS, 0)
    subprocess.run([sys.executable, "-c", PROGRAM], check=True, env={**os.environ, "HERE": str(here)})


def test_all_but_the_loop_stand_back_in_lockstep_and_observers_always() -> None:
    roles = contract().roles
    assert {name for name, role in roles.items() if not in_background(role, "lockstep")} == {"robot", "tissue", "control"}
    observers = {name for name, role in roles.items() if role.observer}
    assert {name for name, role in roles.items() if in_background(role, "wallclock")} == observers
