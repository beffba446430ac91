"""The wall that stiffens and is tensed by muscle, and its breaths, against numpy and the Python classes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from model_exchange import Exchange

from palpate_fmu.compiling import native
from palpate_fmu.export import build_fmu
from palpate_fmu.instance import FmuInstance
from palpate_models.patient.breathing import Breathing, BreathingCurve
from palpate_models.patient.phantom import PhantomModel, build_phantom
from palpate_models.patient.schema import Phantom, Stiffness

BREATHING = Breathing(kind="held", coughs_per_min=3)
PHANTOM = Phantom(
    edge_m=0.012,
    stiffness=Stiffness(stiffening_per_m=500, prony_g=(0.3,), prony_tau_s=(2.0,), friction=0.0),
    breathing=BREATHING,
)
"""Its modulus stops to rise at a depth of 7.7 mm."""
RADIUS_M = 0.015


@pytest.fixture(scope="module")
def model() -> PhantomModel:
    """A phantom that is tensed on its right side."""
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
