"""Atomic writes of files that other programs read; results that a kill has left elsewhere; the fingerprint of the platform."""

import os
import platform
import re
from collections.abc import Iterator
from contextlib import contextmanager
from glob import escape
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import psutil

from palpate.console import say

PACKAGES = (
    "numpy", "scipy", "dartpy", "pin", "coal", "casadi", "numba", "ompl", "ruckig", "rosbags", "eclipse-zenoh", "scikit-learn",
)  # fmt: skip
"""Libraries whose version can change a result."""


def _cpu() -> str:
    path = Path("/proc/cpuinfo")
    if path.is_file():
        for line in path.read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or "unknown"


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def fingerprint() -> dict[str, Any]:
    """Return the versions of operating system, processor, Python and libraries."""
    return {
        "system": platform.platform(),
        "libc": " ".join(platform.libc_ver()),
        "cpu": _cpu(),
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        "packages": {package: found for package in PACKAGES if (found := _version(package))},
    }


@contextmanager
def write_draft(path: Path) -> Iterator[Path]:
    """Yield the path of a draft that replaces `path` at the end: readers see the old file or the new one, even after a kill."""
    draft = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        yield draft
        draft.replace(path)
    finally:
        draft.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write a text file atomically. Raises OSError."""
    with write_draft(path) as draft:
        draft.write_text(text, encoding="utf-8")


def bring_back(path: Path) -> None:
    """Restore the results that a killed run with --overwrite had moved away, or name them if their folder has others now."""
    for aside in sorted(path.parent.glob(f".{escape(path.name)}.*")):
        process = aside.suffix[1:]
        if not re.fullmatch(r"\d{1,9}", process) or psutil.pid_exists(int(process)):
            continue
        place = path.with_name(f"{path.name}-before-{process}") if path.exists() else path
        aside.rename(place)
        say(f"{place}: earlier results of {path}, which a killed run with --overwrite had moved away")
