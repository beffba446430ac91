"""Reference results, kept in the folder, in FMPy and in other importers."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import fmpy
import numpy as np
import pytest

from palpate_fmu.instance import FmuInstance
from palpate_fmu.probing import COLUMNS, Probing, plot_probing, probe, write_csv

REFERENCE = Path(__file__).parents[1] / "reference" / "probing.csv"
"""A probing motion on the fixtures' phantom, every tenth row. Written by write_csv, rows thinned, when equations change."""


def test_probing_gives_the_reference_results(fmu: Path) -> None:
    assert REFERENCE.read_text(encoding="utf-8").splitlines()[0] == COLUMNS
    expected = np.loadtxt(REFERENCE, delimiter=",", skiprows=1)
    with FmuInstance(fmu) as instance:
        found = probe(instance, at_m=(-0.05, -0.05), hold_s=0.5).table()[::10]
    scale = np.abs(expected).max(axis=0)
    np.testing.assert_allclose(found / scale, expected / scale, atol=1e-9)
    assert expected[:, 2].max() > 3


def test_a_lesion_is_stiffer_and_force_relaxes_while_held(fmu3: Path) -> None:
    relaxed = {"breathing_scale": 0.0, "voluntary": 0, "activation": 0.0}
    with FmuInstance(fmu3, values=relaxed) as on, FmuInstance(fmu3, values=relaxed) as off:
        stiff, soft = probe(on, at_m=(-0.05, -0.05)), probe(off, at_m=(0.05, -0.05))
    assert stiff.force.max() > 2 * soft.force.max()
    held = (stiff.time > 0.61) & (stiff.time < 1.6)
    np.testing.assert_allclose(stiff.depth[held], 0.010, atol=1e-4)
    assert (np.diff(stiff.force[held]) < 0).all()
    assert stiff.energy[-1] < 0.05 * stiff.energy.max()


def test_plot_and_csv_are_written(tmp_path: Path) -> None:
    t = np.linspace(0, 1, 20)
    probing = Probing(t, 0.01 * t, t**1.5, np.arange(20, dtype=np.int32), t)
    write_csv(probing, tmp_path / "a.csv")
    plot_probing(probing, tmp_path / "a.png", "test")
    np.testing.assert_array_equal(np.loadtxt(tmp_path / "a.csv", delimiter=",", skiprows=1), probing.table())
    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")


def test_it_simulates_in_fmpy_with_inputs_from_a_table(fmu3: Path) -> None:
    t = np.linspace(0, 0.5, 51)
    signals = np.zeros(len(t), dtype=[("time", float), ("indenter_position", float, 3), ("indenter_velocity", float, 3)])
    signals["time"], signals["indenter_position"][:, 1] = t, 0.05
    signals["indenter_position"][:, 2] = 0.02 - 0.04 * t
    signals["indenter_velocity"][:, 2] = -0.04
    outputs = ["normal_force", "indentation_depth", "contact_force"]
    still = {"breathing_scale": 0.0}
    result = fmpy.simulate_fmu(str(fmu3), stop_time=0.5, output_interval=1e-3, input=signals, output=outputs, start_values=still)
    assert result["time"][-1] == pytest.approx(0.5)
    assert result["normal_force"][-1] > 0.5
    np.testing.assert_allclose(np.diff(result["indentation_depth"][100:300]), 4e-5, rtol=0.05)


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
