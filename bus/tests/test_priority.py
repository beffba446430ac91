"""Who gives way."""

from __future__ import annotations

import os
import subprocess
import sys

PROGRAM = """
import os, sys, threading, time
from palpate_bus.priority import BACKGROUND, in_the_background
in_the_background()  # elsewhere than on Linux it lowers the priority at most
after = threading.Thread(target=time.sleep, args=(30,), daemon=True)
after.start()
for thread in (0, after.native_id) if sys.platform == "linux" else ():
    assert os.sched_getscheduler(thread) == os.SCHED_BATCH
    assert os.getpriority(os.PRIO_PROCESS, thread) == min(int(os.environ["HERE"]) + BACKGROUND, 19)
"""


def test_a_service_goes_behind_others_with_the_threads_that_it_starts() -> None:
    here = os.getpriority(os.PRIO_PROCESS, 0)
    subprocess.run([sys.executable, "-c", PROGRAM], check=True, env={**os.environ, "HERE": str(here)})
