"""The FMU as importers see it, against its reference and the wall's laws."""

import re
from itertools import pairwise
from pathlib import Path
from typing import Any

import fmpy
import numpy as np
import pytest
from fmpy.validation import validate_fmu
from model_exchange import Exchange

from palpate_fmu.compiling import native
from palpate_fmu.export import build_fmu
from palpate_fmu.instance import FmuInstance
from palpate_fmu.probing import COLUMNS, probe
from palpate_fmu.reading import FmuError
from palpate_fmu.variables import TABLE, Sizes, VariableKind
from palpate_models.patient.motion import Breathing, BreathingCurve
from palpate_models.patient.phantom import build_phantom
from palpate_models.patient.schema import Phantom


def press(fmu: FmuInstance, steps: int = 300, first: int = 0) -> np.ndarray:
    """Slide down into the abdomen from step `first` on; the force at each step."""
    motion, wrench = fmu.port(["indenter_position", "indenter_velocity"]), fmu.port(["contact_force", "contact_torque"])
    forces = []
    for k in range(first, first + steps):
        motion["indenter_position"][:] = (-0.05 + 1e-5 * k, -0.05, 0.012 - 4e-5 * k)
        motion["indenter_velocity"][:] = (0.01, 0.0, -0.04)
        motion.push()
        fmu.step(k * 1e-3, 1e-3)
        forces.append(wrench.pull().copy())
    return np.array(forces)


def ball(folder: Path, version: int) -> Path:
    """Return the FMU of a phantom of some 130 vertices."""
    trimesh = pytest.importorskip("trimesh")
    trimesh.creation.icosphere(subdivisions=3, radius=0.06).apply_translation((0, 0, -0.06)).export(folder / "ball.stl")
    phantom = Phantom(kind="mesh", mesh=str(folder / "ball.stl"), edge_m=0.02)
    return build_fmu(phantom, 0, folder / "ball.fmu", version, [native()])


@pytest.mark.parametrize("version", [2, 3])
def test_the_description_is_valid(version: int, tmp_path: Path) -> None:
    """All but the grammar of FMI 2.0's names, of which there is one for each element."""
    names = version == 3
    fmpy.read_model_description(str(ball(tmp_path, version)), validate_variable_names=names, validate_model_structure=True)


@pytest.mark.slow
def test_every_name_of_fmi_2_is_in_its_grammar(tmp_path: Path) -> None:
    """FMPy takes many milliseconds for each."""
    assert validate_fmu(str(ball(tmp_path, 2))) == []


def test_every_real_number_has_a_unit_and_what_can_be_set_has_bounds(fmu: Path) -> None:
    for v in fmpy.read_model_description(str(fmu)).modelVariables:
        assert v.unit or v.type not in ("Real", "Float64"), v.name
        assert None not in (v.min, v.max) or v.causality not in ("input", "parameter"), v.name


def test_value_references_do_not_overlap() -> None:
    sizes = Sizes(vertices=4_000_000, triangles=1, samples=400, branches=4)
    scalars = [(v.vr, v.count(sizes) if 2 in v.versions else 1) for v in TABLE]  # FMI 3.0 has one for an array
    assert all(vr + count <= following for (vr, count), (following, _) in pairwise(sorted(scalars)))


def test_both_versions_give_the_same_numbers(fmu2: Path, fmu3: Path) -> None:
    with FmuInstance(fmu2) as older, FmuInstance(fmu3) as newer:
        forces = press(older)
        np.testing.assert_array_equal(forces, press(newer))
        assert np.abs(forces[:, 2]).max() > 1
        sample = older.get("sample_displacement")
        places = newer.get("rest_position")
        index = [int(np.linalg.norm(places - place, axis=1).argmin()) for place in older.get("sample_position")]
        np.testing.assert_array_equal(sample, newer.get("surface_displacement")[index])
        assert len(set(index)) == len(index) == 64
        scalars = ("indentation_depth", "normal_force", "tangential_force", "contacts", "elastic_energy", "breathing_excursion")
        assert [older.get(name) for name in scalars] == [newer.get(name) for name in scalars]


def test_what_can_be_read_is_what_was_exported(fmu3: Path, phantom: Phantom) -> None:
    model = build_phantom(phantom, 1)
    with FmuInstance(fmu3) as fmu:
        np.testing.assert_array_equal(fmu.get("rest_position"), model.vertices)
        np.testing.assert_array_equal(fmu.get("rest_normal"), model.normals)
        for name in ("background", "lesion", "triangles"):
            np.testing.assert_array_equal(fmu.get(name), getattr(model, name))
        np.testing.assert_allclose(fmu.get("stiffness"), model.stiffness, rtol=1e-13)
        assert all(np.isfinite(fmu.get(v.name)).all() for v in TABLE if v.kind is VariableKind.FIXED and 3 in v.versions)


def test_lesions_are_parameters(fmu3: Path, phantom: Phantom) -> None:
    lesion = phantom.lesions[0]
    moved = phantom.model_copy(update={"lesions": (lesion.model_copy(update={"centre_m": (0.04, 0.02), "contrast": 6.0}),)})
    centre = np.zeros((8, 2))
    centre[0] = (0.04, 0.02)
    values = {"lesion_centre": centre, "lesion_contrast": [6.0, *[1.0] * 7], "stiffness_scale": 1.25}
    with FmuInstance(fmu3, values=values) as fmu:
        model = build_phantom(moved, 1)
        np.testing.assert_allclose(fmu.get("stiffness"), 1.25 * model.stiffness, rtol=1e-13)
        np.testing.assert_array_equal(fmu.get("lesion"), model.lesion)
    with FmuInstance(fmu3, values={"lesion_count": 0}) as fmu:
        np.testing.assert_array_equal(fmu.get("stiffness"), fmu.get("background"))
        assert (fmu.get("lesion") == -1).all()


BAD_VALUES = (
    ("indenter_position", (np.nan, 0.0, 0.0), ("indenter_position", "nan", "-10 to 10")),
    ("indenter_position", (0.0, np.inf, 0.0), ("indenter_position", "inf")),
    ("indenter_velocity", (0.0, 0.0, 1e9), ("indenter_velocity", "1e+09")),
    ("indenter_radius", -0.01, ("indenter_radius", "-0.01", "0.001 to 0.1")),
    ("stiffness_scale", 2.0, ("stiffness_scale", "fixed")),
    ("contact_force", (0.0, 0.0, 1.0), ("contact_force", "output")),
)
IMPOSSIBLE_STEPS = (
    (0.1, 1e-3, "going back"), (0.5, 1e-3, "time reached"), (0.3, -1e-3, "expected more than 0"), (0.3, np.nan, "nan"),
    (np.nan, 1e-3, "nan"), (0.3, 1e9, "at most 60"),
)  # fmt: skip


def test_a_bad_value_or_step_is_refused_with_a_message_and_nothing_changes(fmu: Path) -> None:
    with FmuInstance(fmu) as one, FmuInstance(fmu) as other:
        press(one)
        press(other)
        before = one.get("indenter_position")
        for name, value, words in BAD_VALUES:
            with pytest.raises(FmuError, match="Error") as caught:
                one.set(name, value)
            assert all(word in str(caught.value) for word in words), (name, value)
            np.testing.assert_array_equal(one.get("indenter_position"), before)
        for t, dt, word in IMPOSSIBLE_STEPS:
            with pytest.raises(FmuError, match=re.escape(word)):
                one.step(t, dt)
        np.testing.assert_array_equal(press(one, 50, 300), press(other, 50, 300))


def test_parameters_that_disagree_are_refused(fmu: Path) -> None:
    with pytest.raises(FmuError, match="prony_g must sum to less than 1"):
        FmuInstance(fmu, values={"prony_g": [0.5, 0.5, 0.2, 0.0]})
    with pytest.raises(FmuError, match="activation must be 0 to 1"):
        FmuInstance(fmu, values={"activation": 1.5})
    with pytest.raises(FmuError, match="sub-steps"):
        FmuInstance(fmu, values={"dashpot": 1e-4})


CALLS = {
    2: ("getFMUstate", "serializeFMUstate", "freeFMUstate", "deSerializeFMUstate", "setFMUstate"),
    3: ("getFMUState", "serializeFMUState", "freeFMUState", "deserializeFMUState", "setFMUState"),
}
"""FMPy's names in FMI 2.0 and 3.0."""


def save(instance: FmuInstance) -> bytes:
    get, serialize, free, *_ = (getattr(instance._fmu, name) for name in CALLS[instance.version])
    state = get()
    saved = bytes(serialize(state))
    free(state)
    return saved


def restore(instance: FmuInstance, saved: bytes) -> None:
    *_, free, deserialize, set_state = (getattr(instance._fmu, name) for name in CALLS[instance.version])
    state = deserialize(saved)
    set_state(state)
    free(state)


def test_a_state_can_be_saved_and_loaded_even_by_another_instance(fmu: Path) -> None:
    with FmuInstance(fmu, values={"friction": 0.5}) as one, FmuInstance(fmu) as other:
        press(one)
        saved = save(one)
        ahead = press(one, 200, 300)
        restore(one, saved)
        np.testing.assert_array_equal(press(one, 200, 300), ahead)
        restore(other, saved)
        assert other.get("friction") == 0.5
        np.testing.assert_array_equal(press(other, 200, 300), ahead)


def test_the_state_of_another_phantom_is_refused(fmu: Path, phantom: Phantom, tmp_path: Path) -> None:
    """It has the same size, and its wall the same vertices."""
    stiffer = phantom.model_copy(update={"stiffness": phantom.stiffness.model_copy(update={"k_w_n_per_m3": 1.8e5})})
    with FmuInstance(fmu) as one:
        different = build_fmu(stiffer, 1, tmp_path / "stiffer.fmu", one.version, [native()])
        with FmuInstance(different) as other:
            press(other)
            saved = save(other)
            press(one)
            with pytest.raises(Exception, match="etFMU"):
                restore(one, saved)
            with FmuInstance(fmu) as same:
                press(same)
                np.testing.assert_array_equal(press(one, 50, 300), press(same, 50, 300))


def test_a_long_step_is_cut_and_agrees_with_short_ones(fmu3: Path) -> None:
    with FmuInstance(fmu3) as coarse, FmuInstance(fmu3) as fine:
        for fmu, n in ((coarse, 1), (fine, 10)):
            fmu.set("indenter_position", (0.0, 0.05, 0.02))
            fmu.step(0.0, 1e-3)
            for k in range(100):
                for j in range(n):
                    share = (k + (j + 1) / n) / 100
                    fmu.set("indenter_position", (0.0, 0.05, 0.02 - 0.02 * share))
                    fmu.step(1e-3 + 0.01 * k + 0.01 * j / n, 0.01 / n)
        force = coarse.get("contact_force")[2]
        assert force > 1
        # A step gives its mean force: over 10 ms against over the last of them.
        assert abs(force - fine.get("contact_force")[2]) < 0.03 * force
        np.testing.assert_allclose(coarse.get("surface_displacement"), fine.get("surface_displacement"), atol=1e-12)


def test_a_file_that_is_no_phantom_gives_no_instance(fmu3: Path, tmp_path: Path) -> None:
    folder = Path(fmpy.extract(str(fmu3), unzipdir=str(tmp_path / "broken")))
    data = (folder / "resources" / "phantom.bin").read_bytes()
    description = fmpy.read_model_description(str(folder))
    nan = data[:4000] + b"\xff" * 8 + data[4008:]
    said: list[str] = []
    for content in (b"", data[:100], data[:-1], b"X" + data[1:], data[:72] + b"\xff\xff\xff\x7f" + data[76:], nan):
        (folder / "resources" / "phantom.bin").write_bytes(content)
        said.clear()
        with pytest.raises(Exception, match="instantiate"):
            fmpy.simulation.instantiate_fmu(str(folder), description, logger=lambda *a: said.append(str(a[-1])))
        assert "phantom.bin" in said[0]


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
