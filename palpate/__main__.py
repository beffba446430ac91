"""Entry point of the `palpate` command.

Results must not depend on how many threads a BLAS uses, nor on the kernels that it chooses for a processor, nor on Python's hash
seed, and these are read when the interpreter and the libraries start. So where they are not fixed yet, this fixes them and starts
anew before anything heavy is imported.
"""

from __future__ import annotations

import os
import platform
import signal
import sys

KERNELS = {"x86_64": "Haswell"}
"""OpenBLAS kernels by machine: those of AVX2. With its own choice a surface fit differed in the last bit between processors."""
FIXED = {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "PYTHONHASHSEED": "0",
    **({"OPENBLAS_CORETYPE": KERNELS[platform.machine()]} if platform.machine() in KERNELS else {}),
}
"""The same is in docker-compose.yml."""


def main() -> None:
    """Runs the command in an environment that makes its runs repeatable."""
    if any(os.environ.get(name) != value for name, value in FIXED.items()):
        os.execve(sys.executable, [sys.executable, "-m", "palpate", *sys.argv[1:]], {**os.environ, **FIXED})
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # `docker stop`, systemd: what Ctrl-C does
    if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:  # nohup
        signal.signal(signal.SIGHUP, signal.default_int_handler)  # the terminal was closed
    try:
        from palpate.commands import main as run  # noqa: PLC0415
    except ModuleNotFoundError as error:
        if error.name != "typer":
            raise
        sys.exit("palpate: bus and contract are installed, the command line is not: pip install 'palpate[run]'")
    run()


if __name__ == "__main__":
    main()
