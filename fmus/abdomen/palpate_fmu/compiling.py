"""Cross-compiling a folder of C into the shared libraries of an FMU, by zig's C compiler from PyPI."""

import platform
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from importlib import metadata
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from palpate_errors import UserError
from palpate_models.numerics.cache import content_key, remember

WARNINGS = ("-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Werror", "-Wno-strict-prototypes")
"""The one exception is for the standard's own headers."""
OPTIMISE = ("-O3", "-ffp-contract=off", "-fno-sanitize=all", "-g0")
"""No contraction into fused operations, so that platforms agree to the last bits of libm."""


class Platform(NamedTuple):
    """A target by its folder names in FMI."""

    tuple_3: str
    """Folder in FMI 3.0."""
    folder_2: str | None
    """Folder in FMI 2.0, which has no name for 64-bit ARM."""
    triple: str
    """The target by zig's name."""
    suffix: str


PLATFORMS: tuple[Platform, ...] = (
    Platform("x86_64-linux", "linux64", "x86_64-linux-gnu.2.17", ".so"),
    Platform("aarch64-linux", None, "aarch64-linux-gnu.2.17", ".so"),
    Platform("x86_64-windows", "win64", "x86_64-windows-gnu", ".dll"),
    Platform("aarch64-windows", None, "aarch64-windows-gnu", ".dll"),
    Platform("x86_64-darwin", "darwin64", "x86_64-macos.11.0", ".dylib"),
    Platform("aarch64-darwin", None, "aarch64-macos.11.0", ".dylib"),
)


class CompileError(UserError):
    """The C compiler refused; holds what it said."""


def platforms(version: int, names: Sequence[str] | None = None) -> tuple[Platform, ...]:
    """Return the platforms that an FMI version has a folder for; those of `names` (of FMI 3.0), if given.

    Raises CompileError naming one that is not known.
    """
    known = {target.tuple_3: target for target in PLATFORMS if version >= 3 or target.folder_2}
    if names is None:
        return tuple(known.values())
    for name in names:
        if name not in known:
            raise CompileError(f"FMI {version} has no platform {name!r}; platforms are {', '.join(known)}")
    return tuple(known[name] for name in names)


def native() -> str:
    """Return the platform of this machine, by its name in FMI 3.0."""
    name = platform.machine().lower()
    machine = {"arm64": "aarch64", "amd64": "x86_64"}.get(name, name)
    return f"{machine}-{platform.system().lower()}"


def fmi_headers() -> Path:
    """Return the folder of the standard's C headers, which the FMPy package brings."""
    import fmpy  # noqa: PLC0415  (slow to import)

    return Path(fmpy.__file__).parent / "c-code"


def compile_library(folder: Path, sources: Sequence[str], target: Platform) -> bytes:
    """Return the shared library of `sources` in `folder` for a platform; remembered in a cache by their content."""
    code = sorted(folder.glob("*.[ch]"))
    inputs = (metadata.version("ziglang"), target, WARNINGS, OPTIMISE, list(sources), [path.name for path in code])

    def compiled() -> NDArray[np.uint8]:
        with tempfile.TemporaryDirectory() as work:
            out = Path(work) / f"library{target.suffix}"
            link = ["-shared", "-fvisibility=hidden", "-s", "-o", str(out), *sources]
            if "windows" not in target.triple:
                link += ["-fPIC", "-lm"]
            command = [sys.executable, "-m", "ziglang", "cc", "-target", target.triple, *WARNINGS, *OPTIMISE, *link]
            done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
            if done.returncode or not out.is_file():
                raise CompileError(f"cannot compile for {target.tuple_3}:\n{done.stderr}")
            return np.frombuffer(out.read_bytes(), np.uint8)

    return remember(content_key("fmu", code, *inputs), compiled).tobytes()
