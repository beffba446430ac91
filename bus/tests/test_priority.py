"""Who gives way."""

from __future__ import annotations

import os
import subprocess
import sys

PROGRAM = """
import os, sys, threading, time
from palpate_bus.priority import BACKGROUND, in_the_background
before = threading.Thread(target=time.sleep, args=(30,), daemon=True)
before.start()
in_the_background()  # elsewhere than on Linux it does nothing
for thread in (0, before.native_id) if sys.platform == "linux" else ():
    assert os.sched_getscheduler(thread) == os.SCHED_BATCH
    assert os.getpriority(os.PRIO_PROCESS, thread) == max(BACKGROUND, int(os.environ["HERE"]))
"""


def test_all_threads_of_an_observer_go_behind_others() -> None:
    here = os.getpriority(os.PRIO_PROCESS, 0)
    subprocess.run([sys.executable, "-c", PROGRAM], check=True, env={**os.environ, "HERE": str(here)})
