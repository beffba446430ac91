"""The FMU against its reference and the wall's laws."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from model_exchange import Exchange

from palpate_fmu.compiling import native
from palpate_fmu.export import build_fmu
from palpate_fmu.instance import FmuInstance
from palpate_fmu.probing import COLUMNS, probe
from palpate_models.patient.breathing import Breathing, BreathingCurve
from palpate_models.patient.schema import Phantom

REFERENCE = Path(__file__).parents[1] / "reference" / "probing.csv"
"""A probing motion on the fixtures' phantom, every tenth row. Written by plot_probing, rows thinned, when equations change."""


def test_probing_gives_the_reference_results(fmu: Path) -> None:
    assert REFERENCE.read_text(encoding="utf-8").splitlines()[0] == COLUMNS
    expected = np.loadtxt(REFERENCE, delimiter=",", skiprows=1)
    with FmuInstance(fmu) as instance:
        found = probe(instance, at_m=(-0.05, -0.05), hold_s=0.5)[::10]
    scale = np.abs(expected).max(axis=0)
    np.testing.assert_allclose(found / scale, expected / scale, atol=1e-9)
    assert expected[:, 2].max() > 3


def test_libcosim_steps_it_too(fmu2: Path) -> None:
    """The Open Simulation Platform's master, by its own FMI library."""
    execution_module = pytest.importorskip("libcosimpy.CosimExecution", reason="libcosimpy is not installed")
    from libcosimpy.CosimLogging import CosimLogLevel, log_output_level
    from libcosimpy.CosimManipulator import CosimManipulator
    from libcosimpy.CosimObserver import CosimObserver
    from libcosimpy.CosimSlave import CosimLocalSlave

    log_output_level(CosimLogLevel.ERROR)
    execution: Any = execution_module.CosimExecution.from_step_size(1_000_000)
    slave = execution.add_local_slave(CosimLocalSlave(fmu_path=str(fmu2), instance_name="abdomen"))
    override, observer = CosimManipulator.create_override(), CosimObserver.create_last_value()
    execution.add_manipulator(override)
    execution.add_observer(observer)
    forces = []
    with FmuInstance(fmu2) as ours:
        expected = []
        for k in range(300):
            place = [0.0, 0.05, 0.02 - 5e-5 * k]
            override.slave_real_values(slave, [1, 2, 3], place)
            assert execution.step()
            forces.append(observer.last_real_values(slave, [10, 11, 12]))
            ours.set("indenter_position", place)
            ours.step(k * 1e-3, 1e-3)
            expected.append(ours.get("contact_force"))
    np.testing.assert_allclose(forces, expected, rtol=1e-12, atol=1e-12)
    assert np.abs(expected).max() > 1


BREATHING = Breathing(kind="held", coughs_per_min=3)


def test_the_breaths_are_those_of_the_python_class(tmp_path: Path) -> None:
    path = build_fmu(Phantom(edge_m=0.02, breathing=BREATHING), 1, tmp_path / "a.fmu", 3, [native()])
    curve = BreathingCurve(BREATHING, 1)
    times = np.concatenate((np.linspace(-100, 3 * curve.repeats_s, 4001), curve.table[:, 0]))
    with Exchange(path, {"breathing_scale": 0.5, "breathing_offset": 7.0}) as exchange:
        found, slopes = [], []
        for time in times:
            exchange.fmu.setTime(time)
            found.append(exchange.value("breathing_excursion")[0])
            slopes.append(exchange.derivative(["breathing_excursion"], {"time": np.ones(1)})["breathing_excursion"][0])
    np.testing.assert_allclose(found, [0.5 * curve.excursion(time + 7.0) for time in times], atol=1e-12)
    change = [0.5 * (curve.excursion(t + 7 + 1e-6) - curve.excursion(t + 7 - 1e-6)) / 2e-6 for t in times]
    np.testing.assert_allclose(slopes, change, atol=1e-6)
    assert max(found) > 0.005
