"""Makes the odd FMU importable and gives the tests of the elastic tissue one cache of compliances."""

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))


@pytest.fixture(autouse=True, scope="module")
def shared_cache(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """FMUs stay in the user's cache: a compiler without its own cache takes seconds more."""
    with pytest.MonkeyPatch.context() as patch:
        if {"elastic", "press"} & set(request.path.stem.split("_")):
            patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.getbasetemp() / "compliances"))
        yield
