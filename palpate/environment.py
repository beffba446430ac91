"""Environment variables that make the results of a run repeatable.

Results must not depend on how many threads a BLAS uses, nor on the kernels that it chooses for a processor, nor on Python's hash
seed. All of these are read when the interpreter and the libraries start.
"""

import os
import platform
from collections.abc import Iterator, Mapping
from contextlib import contextmanager

KERNELS = {"x86_64": "Haswell"}
"""OpenBLAS kernels by machine: those of AVX2. With its own choice a surface fit differed in the last bit between processors."""
FIXED = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "PYTHONHASHSEED": "0"}
"""docker-compose.yml sets the same."""
if platform.machine() in KERNELS:
    FIXED["OPENBLAS_CORETYPE"] = KERNELS[platform.machine()]


@contextmanager
def set_environment(variables: Mapping[str, str]) -> Iterator[None]:
    """Temporarily sets environment variables."""
    before = dict(os.environ)
    os.environ.update(variables)
    try:
        yield
    finally:
        for name in variables:
            del os.environ[name]
        os.environ.update(before)
