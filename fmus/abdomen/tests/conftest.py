"""FMUs for the tests of this folder, for this platform only."""

from pathlib import Path

import pytest

from palpate_fmu.compiling import native
from palpate_fmu.export import build_fmu
from palpate_models.patient.motion import Breathing
from palpate_models.patient.schema import Lesion, Phantom, Stiffness
from palpate_models.patient.wall import Guarding

PHANTOM = Phantom(
    stiffness=Stiffness(k_w_n_per_m3=1.7e5, length_m=0.015, stiffening_per_m=80),
    lesions=(Lesion(centre_m=(-0.05, -0.05)),),
    guarding=(Guarding(centre_m=(-0.03, -0.02), kind="voluntary"),),
    breathing=Breathing(kind="quiet", peak_to_peak_m=0.004),
    edge_m=0.012,
)
"""It has all that the wall can do: it stiffens, is guarded and breathes."""


@pytest.fixture(scope="session")
def phantom() -> Phantom:
    return PHANTOM


@pytest.fixture(scope="session")
def fmu3(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build_fmu(PHANTOM, 1, tmp_path_factory.mktemp("fmi3") / "abdomen.fmu", 3, [native()])


@pytest.fixture(scope="session")
def fmu2(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build_fmu(PHANTOM, 1, tmp_path_factory.mktemp("fmi2") / "abdomen.fmu", 2, [native()])


@pytest.fixture(params=[2, 3], ids=["fmi2", "fmi3"])
def fmu(request: pytest.FixtureRequest) -> Path:
    chosen: Path = request.getfixturevalue(f"fmu{request.param}")
    return chosen
