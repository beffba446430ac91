"""CasADi's DaeBuilder takes the FMU for model exchange: right-hand side, forces, derivatives and an integration."""

import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from model_exchange import Exchange, coarse_phantom

from palpate_fmu.compiling import native
from palpate_fmu.export import build_fmu

casadi = pytest.importorskip("casadi")


@pytest.fixture(scope="module")
def coarse(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build_fmu(coarse_phantom(), 1, tmp_path_factory.mktemp("coarse") / "abdomen.fmu", 2, [native()])


@pytest.fixture(scope="module")
def dae(coarse: Path, tmp_path_factory: pytest.TempPathFactory) -> Any:
    folder = tmp_path_factory.mktemp("casadi")
    with zipfile.ZipFile(coarse) as archive:
        archive.extractall(folder)
    builder = casadi.DaeBuilder("abdomen", str(folder), {})
    builder.set_y([name for name in builder.y() if name != "contacts"])  # CasADi reads all outputs as real numbers
    return builder


def pressed(exchange: Exchange, dae: Any) -> tuple[np.ndarray, np.ndarray]:
    """States under a sphere that has been pressed 8 mm deep for a moment, and DaeBuilder's inputs for it there."""
    place, velocity = np.array([0.001, 0.05, 0.0065]), np.array([0.01, 0.0, -0.02])
    exchange.put(place, velocity)
    x = exchange.euler(np.zeros(exchange.states), 30)
    values = {f"indenter_position[{k + 1}]": place[k] for k in range(3)}
    values |= {f"indenter_velocity[{k + 1}]": velocity[k] for k in range(3)}
    return x, np.array([values.get(name, 0.0) for name in dae.u()])


def test_right_hand_side_and_force_are_those_of_the_fmu(coarse: Path, dae: Any) -> None:
    with Exchange(coarse) as exchange:
        assert dae.nx() == exchange.states
        x, u = pressed(exchange, dae)
        rates, force = exchange.rates(x), exchange.value("contact_force")
        function = dae.create("f", ["t", "x", "u"], ["ode", "y"])
        ode, y = function(0.0, x, u)
        np.testing.assert_array_equal(np.asarray(ode).ravel(), rates)
        outputs = dict(zip(dae.y(), np.asarray(y).ravel(), strict=True))
        np.testing.assert_array_equal([outputs[f"contact_force[{k}]"] for k in (1, 2, 3)], force)
        assert force[2] > 1


def test_a_variable_step_solver_with_the_fmus_jacobian_comes_to_an_end_in_contact(coarse: Path, dae: Any) -> None:
    """SUNDIALS' CVODES by CasADi: BDF, sparse Newton. The sphere meets the wall at once, which then follows within some steps."""
    with Exchange(coarse) as exchange:
        _, u = pressed(exchange, dae)
        function = dae.create("f", ["t", "x", "u"], ["ode"])
        t, x, p = casadi.MX.sym("t"), casadi.MX.sym("x", exchange.states), casadi.MX.sym("u", len(u))
        problem = {"t": t, "x": x, "u": p, "ode": function(t, x, p)}
        options = {"newton_scheme": "direct", "linear_solver": "csparse", "reltol": 1e-4, "abstol": 1e-7}
        simulate = casadi.integrator("simulate", "cvodes", problem, 0.0, 0.005, options)
        found = np.asarray(simulate(x0=np.zeros(exchange.states), u=u)["xf"]).ravel()
        assert simulate.stats()["nsteps"] < 200
        exchange.put(np.array([0.001, 0.05, 0.0065]), np.array([0.01, 0.0, -0.02]))
        expected = exchange.runge_kutta(np.zeros(exchange.states), 20, 0.25e-3)
        np.testing.assert_allclose(found, expected, atol=2e-5)
        assert expected.max() > 0.005
