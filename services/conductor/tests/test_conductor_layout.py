"""Children without address-space randomisation."""

from __future__ import annotations

import subprocess
import sys

import pytest

CHILD = "print([line.split('-')[0] for line in open('/proc/self/maps') if 'libc' in line][0])"
PARENT = f"""
import subprocess, sys
from palpate_conductor.layout import share_addresses
print(share_addresses())
for _ in range(2):
    print(subprocess.run([sys.executable, "-c", {CHILD!r}], capture_output=True, text=True, check=True).stdout.strip())
"""


def test_children_have_the_same_addresses() -> None:
    done = subprocess.run([sys.executable, "-c", PARENT], capture_output=True, text=True, check=True)
    allowed, first, second = done.stdout.split()
    if allowed != "True":
        pytest.skip("personality(2) is not allowed here")
    assert first == second
