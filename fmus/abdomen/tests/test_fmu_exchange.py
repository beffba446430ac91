"""Model exchange: the ODE against the co-simulation's step, its derivatives, its errors, and in CasADi."""

import zipfile
from pathlib import Path
from typing import Any

import fmpy
import numpy as np
import pytest
from model_exchange import Exchange, coarse_phantom

from palpate_fmu.compiling import native
from palpate_fmu.export import build_fmu

STEP_S = 1e-3
STILL = {"breathing_scale": 0.0}
OUTPUTS = ["contact_force", "contact_torque", "contacts", "surface_displacement"]


@pytest.fixture(scope="module")
def coarse(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build_fmu(coarse_phantom(), 1, tmp_path_factory.mktemp("coarse3") / "abdomen.fmu", 3, [native()])


def motion(ahead_s: float, stop_s: float = 0.4) -> np.ndarray:
    """Pressed 9 mm deep by 40 mm/s, then slid by 30 mm/s; `ahead_s` before its time."""
    t = np.linspace(0, stop_s, round(stop_s / STEP_S) + 1)
    late = t + ahead_s > 0.3
    inputs = [(f"indenter_{name}", float, 3) for name in ("position", "velocity", "angular_velocity")]
    signals = np.zeros(len(t), dtype=[("time", float), *inputs])
    signals["time"] = t
    place, velocity = signals["indenter_position"], signals["indenter_velocity"]
    place[:, 1] = 0.05 + np.where(late, 0.03 * (t + ahead_s - 0.3), 0)
    place[:, 2] = 0.018 - 0.04 * np.minimum(t + ahead_s, 0.3)
    velocity[:, 1], velocity[:, 2] = np.where(late, 0.03, 0), np.where(late, 0, -0.04)
    return signals


def run(path: Path, kind: str, ahead_s: float, stop_s: float = 0.4, **options: object) -> np.ndarray:
    """Outputs every millisecond. In co-simulation, a row shows the step that ended there, with the input of its begin."""
    return fmpy.simulate_fmu(
        str(path), fmi_type=kind, stop_time=stop_s, output_interval=STEP_S, input=motion(ahead_s, stop_s), output=OUTPUTS,
        start_values=STILL, **options,
    )  # fmt: skip


def test_explicit_euler_is_the_step_of_the_co_simulation(fmu3: Path) -> None:
    """With steps of contact_time.

    The Prony branches and the contraction of muscle are exact there and Euler here, and friction sees the velocity before.
    """
    steps = run(fmu3, "CoSimulation", STEP_S)[1:]
    euler = run(fmu3, "ModelExchange", STEP_S, solver="Euler", step_size=STEP_S)
    force, own = steps["contact_force"], euler["contact_force"][:-1]
    assert np.abs(force[:, 2]).max() > 2
    np.testing.assert_array_equal(euler["contacts"][:-1], steps["contacts"])
    np.testing.assert_allclose(euler["surface_displacement"][1:], steps["surface_displacement"], atol=3e-7)
    np.testing.assert_allclose(own[:, 2], force[:, 2], atol=1e-3)
    np.testing.assert_allclose(own, force, atol=0.01)
    np.testing.assert_allclose(euler["contact_torque"][:-1], steps["contact_torque"], atol=2e-4)


def test_finer_integration_agrees_with_the_co_simulation(coarse: Path) -> None:
    """Contact lags by contact_time, so by a step of the co-simulation."""
    steps = run(coarse, "CoSimulation", STEP_S, 0.3)
    fine = run(coarse, "ModelExchange", 0.0, 0.3, solver="Euler", step_size=STEP_S / 8)
    np.testing.assert_allclose(fine["surface_displacement"][1:], steps["surface_displacement"][:-1], atol=1e-6)
    assert steps["contact_force"][:, 2].max() > 1


@pytest.mark.parametrize("sliding", [False, True], ids=["sticking", "sliding"])
def test_directional_derivatives_are_those_of_finite_differences(fmu: Path, sliding: bool) -> None:
    """All outputs and rates by all inputs, states and time, in contact, while the body breathes and its muscle contracts.

    Tension acts on inward displacement alone, so no vertex is left where its force has a kink.
    """
    inputs = {
        "indenter_position": np.array([-0.049, -0.051, 0.0065]),
        "indenter_velocity": np.array([0.02, -0.01, -0.02]),
        "indenter_angular_velocity": np.array([0.3, -0.2, 0.5]),
    }
    with Exchange(fmu, {"friction": 0.05 if sliding else 0.9}) as exchange:
        for name, value in inputs.items():
            exchange.set(name, value)
        x = exchange.euler(np.append(np.zeros(exchange.states - 1), 0.3), 200 if sliding else 12)
        u = x[: exchange.variables["displacement"].size]
        u[np.abs(u) < 1e-6] = 1e-5
        rates = [name for name in exchange.variables if name.endswith("_rate") and not name.startswith("breathing")]
        outputs = [v.name for v in exchange.variables.values() if v.causality == "output" and v.name != "contacts"]
        names = [*rates, *outputs]

        def at(dx: np.ndarray, du: dict[str, np.ndarray], time: float) -> dict[str, np.ndarray]:
            exchange.fmu.setTime(0.3 + time)
            for name, value in inputs.items():
                exchange.set(name, value + du[name])
            exchange.rates(x + dx)
            return {name: exchange.value(name) for name in names}

        rng = np.random.default_rng(3)
        dx = rng.normal(size=exchange.states)
        du = {"indenter_position": rng.normal(size=3), "indenter_velocity": rng.normal(size=3)}
        du["indenter_angular_velocity"], dt, h = rng.normal(size=3), 2.0, 1e-8
        low, high = (at(s * h * dx, {k: s * h * v for k, v in du.items()}, s * h * dt) for s in (-1, 1))
        at(0 * dx, {k: 0 * v for k, v in du.items()}, 0.0)
        states = ("displacement", "relaxation", "skin_stretch", "activation")
        parts = np.split(dx, np.cumsum([exchange.variables[name].size for name in states])[:-1])
        known = {"time": np.array([dt]), **du, **dict(zip(states, parts, strict=True))}
        found = exchange.derivative(names, known)
        assert exchange.value("contact_force")[2] > 1
        assert exchange.value("tangential_force") > 0.01
        assert abs(found["activation_rate"][0]) > 0.1
        for name in names:
            expected = (high[name] - low[name]) / (2 * h)
            np.testing.assert_allclose(found[name], expected, atol=2e-5 * max(1e-3, np.abs(expected).max()), err_msg=name)


def test_at_rest_the_sphere_holds_its_vertices_exactly(coarse: Path) -> None:
    """No penalty: what remains of a gap vanishes with exp(-t / contact_time)."""
    with Exchange(coarse, STILL) as exchange:
        exchange.set("indenter_position", np.array([0.0, 0.05, 0.006]))
        x = exchange.euler(np.zeros(exchange.states), 400, 0.5e-3)
        held = np.argmax(x[: exchange.variables["displacement"].size])
        deepest = x[held]
        assert deepest > 0.005
        assert abs(exchange.euler(x, 20, 0.5e-3)[held] - deepest) < 1e-12


def test_bad_states_and_calls_are_refused(coarse: Path) -> None:
    with Exchange(coarse) as exchange:
        x = exchange.euler(np.zeros(exchange.states), 3)
        for bad in (np.nan, np.inf, 3.0):
            wrong = x.copy()
            wrong[5] = bad
            with pytest.raises(Exception, match="SetContinuousStates"):
                exchange.rates(wrong)
        np.testing.assert_array_equal(exchange.value("displacement"), x[: exchange.variables["displacement"].size])
        for output, of in (("contact_force", "indenter_radius"), ("rest_position", "indenter_position")):
            with pytest.raises(Exception, match="DirectionalDerivative"):
                exchange.derivative([output], {of: np.ones(exchange.variables[of].size)})
        with pytest.raises(Exception, match="SetTime"):
            exchange.fmu.setTime(float("nan"))
    with pytest.raises(Exception, match="ExitInitializationMode"):
        Exchange(coarse, {"prony_g": np.array([0.2, 0.2, 0.1, 0.0])})  # a branch that is not a state


@pytest.fixture(scope="module")
def older(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build_fmu(coarse_phantom(), 1, tmp_path_factory.mktemp("older") / "abdomen.fmu", 2, [native()])


@pytest.fixture(scope="module")
def dae(older: Path, tmp_path_factory: pytest.TempPathFactory) -> Any:
    casadi, folder = pytest.importorskip("casadi"), tmp_path_factory.mktemp("casadi")
    with zipfile.ZipFile(older) as archive:
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


def test_right_hand_side_and_force_are_those_of_the_fmu(older: Path, dae: Any) -> None:
    with Exchange(older) as exchange:
        assert dae.nx() == exchange.states
        x, u = pressed(exchange, dae)
        rates, force = exchange.rates(x), exchange.value("contact_force")
        function = dae.create("f", ["t", "x", "u"], ["ode", "y"])
        ode, y = function(0.0, x, u)
        np.testing.assert_array_equal(np.asarray(ode).ravel(), rates)
        outputs = dict(zip(dae.y(), np.asarray(y).ravel(), strict=True))
        np.testing.assert_array_equal([outputs[f"contact_force[{k}]"] for k in (1, 2, 3)], force)
        assert force[2] > 1


def test_a_variable_step_solver_with_the_fmus_jacobian_comes_to_an_end_in_contact(older: Path, dae: Any) -> None:
    """SUNDIALS' CVODES by CasADi: BDF, sparse Newton. The sphere meets the wall at once, which then follows within some steps."""
    import casadi

    with Exchange(older) as exchange:
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
