"""The FMU against its reference and the wall's laws."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import fmpy
import numpy as np
import pytest
from model_exchange import Exchange

from palpate_fmu.compiling import native
from palpate_fmu.export import build_fmu
from palpate_fmu.instance import FmuInstance
from palpate_fmu.probing import COLUMNS, Probing, plot_probing, probe, write_csv
from palpate_models.patient.breathing import Breathing, BreathingCurve
from palpate_models.patient.phantom import PhantomModel, build_phantom
from palpate_models.patient.schema import Phantom, Stiffness

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


BREATHING = Breathing(kind="held", coughs_per_min=3)
PHANTOM = Phantom(
    edge_m=0.012, stiffness=Stiffness(stiffening_per_m=500, prony_g=(0.3,), prony_tau_s=(2.0,), friction=0.0), breathing=BREATHING
)
"""Its modulus stops to rise at a depth of 7.7 mm."""
RADIUS_M = 0.015


@pytest.fixture(scope="module")
def model() -> PhantomModel:
    """Return a phantom that is tensed on its right side."""
    plain = build_phantom(PHANTOM, 1)
    return replace(plain, tension=np.clip(-plain.vertices[:, 0] / 0.05, 0, 1.6))


@pytest.fixture(scope="module")
def stiffening(model: PhantomModel, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build_fmu(PHANTOM, 1, tmp_path_factory.mktemp("stiffening") / "a.fmu", 3, [native()], RADIUS_M, model)


def test_the_breaths_are_those_of_the_python_class(stiffening: Path) -> None:
    curve = BreathingCurve(BREATHING, 1)
    times = np.concatenate((np.linspace(-100, 3 * curve.repeats_s, 4001), curve.table[:, 0]))
    with Exchange(stiffening, {"breathing_scale": 0.5, "breathing_offset": 7.0}) as exchange:
        found, slopes = [], []
        for time in times:
            exchange.fmu.setTime(time)
            found.append(exchange.value("breathing_excursion")[0])
            slopes.append(exchange.derivative(["breathing_excursion"], {"time": np.ones(1)})["breathing_excursion"][0])
    expected = [0.5 * curve.excursion(time + 7.0) for time in times]
    np.testing.assert_allclose(found, expected, atol=1e-12)
    change = [0.5 * (curve.excursion(t + 7 + 1e-6) - curve.excursion(t + 7 - 1e-6)) / 2e-6 for t in times]
    np.testing.assert_allclose(slopes, change, atol=1e-6)
    assert max(found) > 0.005


def test_springs_give_back_what_they_store(stiffening: Path, model: PhantomModel) -> None:
    """Without contact and branches the energy falls by what the dashpots take, dE/dt = -sum of C u'^2, at any displacement."""
    damping = PHANTOM.stiffness.dashpot_s * model.stiffness * model.areas
    rng = np.random.default_rng(2)
    for activation in (0.0, 0.6):
        with Exchange(stiffening, {"prony_g": np.zeros(4), "activation": activation}) as exchange:
            u = np.where(model.fixed, 0, rng.normal(scale=0.006, size=len(model.areas)))
            x = np.concatenate((u, np.zeros(exchange.states - len(u))))
            rate = exchange.rates(x)[: len(u)]
            change = exchange.derivative(["elastic_energy"], {"displacement": rate})["elastic_energy"][0]
            assert change == pytest.approx(-float(damping @ rate**2), rel=1e-10)
            h = 1e-7
            exchange.rates(x + h * exchange.rates(x))
            after = exchange.value("elastic_energy")[0]
            exchange.rates(x - h * exchange.rates(x))
            assert (after - exchange.value("elastic_energy")[0]) / (2 * h) == pytest.approx(change, rel=1e-4)


def test_the_rates_of_bent_and_straight_springs_have_the_derivative_of_finite_differences(
    stiffening: Path, model: PhantomModel
) -> None:
    """No vertex is near a kink: neither at rest nor at the limit of stiffening."""
    rng = np.random.default_rng(3)
    depth = np.where(rng.random(len(model.areas)) < 0.5, 0.004, 0.012)
    u = depth * np.where(rng.random(len(depth)) < 0.3, -1, 1) * rng.uniform(0.9, 1.1, len(depth))
    direction, h = rng.normal(size=len(u)), 1e-7
    with Exchange(stiffening) as exchange:
        rest = np.append(np.zeros(exchange.states - len(u) - 1), 0.6)
        high, low = (exchange.rates(np.concatenate((u + s * h * direction, rest)))[: len(u)] for s in (1, -1))
        exchange.rates(np.concatenate((u, rest)))
        found = exchange.derivative(["displacement_rate"], {"displacement": direction})["displacement_rate"]
        by_muscle = exchange.derivative(["displacement_rate"], {"activation": np.ones(1)})["displacement_rate"]
    np.testing.assert_allclose(found, (high - low) / (2 * h), atol=1e-6 * np.abs(found).max())
    expected = -model.tension * np.maximum(u, 0) / PHANTOM.stiffness.dashpot_s
    np.testing.assert_allclose(by_muscle, np.where(model.fixed, 0, expected), atol=1e-12)


def test_energy_falls_without_the_sphere(stiffening: Path) -> None:
    """The stability bound of the sub-steps holds for the largest modulus."""
    values = {"breathing_scale": 0.0, "dashpot": 0.0064}
    with FmuInstance(stiffening, values=values) as fmu:
        for k in range(150):
            fmu.set("indenter_position", (-0.06, 0.0, RADIUS_M - 2e-4 * k))
            fmu.step(1e-3 * k, 1e-3)
        energies = [float(fmu.get("elastic_energy"))]
        fmu.set("indenter_position", (0.0, 0.0, 0.9))
        for k in range(150, 400):
            fmu.step(1e-3 * k, 1e-3)
            energies.append(float(fmu.get("elastic_energy")))
        assert energies[0] > 0.1
        assert (np.diff(energies) <= 1e-12).all()
