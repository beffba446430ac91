"""Who gives way."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

PROGRAM = """
import os, threading, time
from palpate_bus.priority import BACKGROUND, in_the_background
before = threading.Thread(target=time.sleep, args=(30,), daemon=True)
before.start()
in_the_background()
for thread in (0, before.native_id):
    assert os.sched_getscheduler(thread) == os.SCHED_BATCH
    assert os.getpriority(os.PRIO_PROCESS, thread) == max(BACKGROUND, int(os.environ["HERE"]))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="priorities of threads are Linux's")
def test_all_threads_of_an_observer_go_behind_others() -> None:
    here = os.getpriority(os.PRIO_PROCESS, 0)
    subprocess.run([sys.executable, "-c", PROGRAM], check=True, env={**os.environ, "HERE": str(here)})
