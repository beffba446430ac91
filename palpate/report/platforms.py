"""Fingerprint of the platform, on which a run hash depends besides scenario, seed and code."""

import os
import platform
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

PACKAGES = ("numpy", "scipy", "dartpy", "pin", "coal", "casadi", "ompl", "ruckig", "rosbags", "eclipse-zenoh", "scikit-learn")
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
