"""Entry point of the `palpate` command.

Results must not depend on how many threads a BLAS uses, nor on Python's hash seed, and both are read when the interpreter and the
libraries start. So where they are not fixed yet, this fixes them and starts anew before anything heavy is imported.
"""

from __future__ import annotations

import os
import sys

FIXED = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "PYTHONHASHSEED": "0"}


def main() -> None:
    """Runs the command in an environment that makes its runs repeatable."""
    if any(os.environ.get(name) != value for name, value in FIXED.items()):
        os.execve(sys.executable, [sys.executable, "-m", "palpate_conductor", *sys.argv[1:]], {**os.environ, **FIXED})
    from palpate_conductor.cli import main as run  # noqa: PLC0415

    run()


if __name__ == "__main__":
    main()
