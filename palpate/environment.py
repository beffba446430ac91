"""What the environment of every process of a run must fix so that its results can be repeated.

Results must not depend on how many threads a BLAS uses, nor on the kernels that it chooses for a processor, nor on Python's hash
seed. All of these are read when the interpreter and the libraries start.
"""

from __future__ import annotations

import platform

KERNELS = {"x86_64": "Haswell"}
"""OpenBLAS kernels by machine: those of AVX2. With its own choice a surface fit differed in the last bit between processors."""
FIXED = {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "PYTHONHASHSEED": "0",
    **({"OPENBLAS_CORETYPE": KERNELS[platform.machine()]} if platform.machine() in KERNELS else {}),
}
"""docker-compose.yml sets the same."""
