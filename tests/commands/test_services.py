"""Implementations of roles: the scenario selects them, unusable ones are refused, a file replaces a service."""

from pathlib import Path

import pytest

import palpate_plugins
from palpate.run import roles
from palpate.run.composed import load_services
from palpate.run.roles import OBSERVERS, WORKERS, check_choices, choice, settings_of
from palpate_bus.implementations import create, kind
from palpate_bus.runtime.failure import Failure
from palpate_bus.testing import HandInbox
from palpate_models.scenario.load import load_scenario
from palpate_models.scenario.schema import Scenario, Services
from palpate_plugins import PluginError, PluginKind

EXAMPLE = Path(__file__).parents[2] / "docs" / "examples" / "threshold_assessment.py"


def chosen(*options: str) -> Scenario:
    return check_choices(load_scenario("healthy", settings_of(options)))


def test_every_role_has_a_choice_and_its_default_is_installed() -> None:
    assert set(Services.model_fields) == {*WORKERS, *OBSERVERS, "search"}
    scenario = chosen()
    for role in Services.model_fields:
        assert choice(scenario, role) in kind(role).names()


@pytest.mark.parametrize("option", ["assessment", "tisue=a.py", "conductor=a.py"])
def test_an_unknown_role_is_named(option: str) -> None:
    with pytest.raises(PluginError, match=rf"--service {option}: expected ROLE=NAME_OR_FILE with ROLE one of robot, tissue"):
        settings_of([option])


def test_an_unknown_implementation_is_refused_with_the_allowed_ones() -> None:
    known = r"services\.robot = 'bullet': expected one of dart, lbr, mujoco, ros2_control, or the path"
    with pytest.raises(PluginError, match=known):
        chosen("robot=bullet")
    with pytest.raises(PluginError, match=r"services\.robot = 'none'"):
        chosen("robot=none")
    assert chosen("tissue=none").services.tissue == "none"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (None, "there is no such file"),
        ("def create(:", r"is not Python: .*line 1"),
        ("x = 1", "no function create"),
        ("1 / 0\ndef create(scenario): ...", "line 1: ZeroDivisionError"),
        ("import math\ndef create(scenario):\n    return math.nosuch", "line 3: AttributeError"),
        ("def create(scenario):\n    return 5", r"create\(\) returned 5, expected a palpate_bus\.service\.Service"),
    ],
)
def test_a_file_without_a_service_is_refused_with_its_line(tmp_path: Path, text: str | None, said: str) -> None:
    file = tmp_path / "mine.py"
    if text is not None:
        file.write_text(text)
    with pytest.raises(PluginError, match=said):
        load_services(chosen(f"assessment={file}"), ("assessment",))


def test_an_exception_in_a_step_is_reported_with_its_line(tmp_path: Path) -> None:
    file = tmp_path / "mine.py"
    file.write_text(
        "from palpate_bus.service import Service\nclass Mine(Service):\n    role = 'assessment'\n"
        "    def step(self, t, inbox):\n        return self.nothing\ndef create(scenario):\n    return Mine()\n"
    )
    service = create("assessment", str(file), load_scenario("healthy"))
    with pytest.raises(AttributeError) as raised:
        service.step(0, HandInbox())
    assert Failure.of(raised.value, "tissue", ()).text.startswith(f"{file}, line 5: AttributeError: ")


def test_a_file_takes_the_place_of_ours(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(EXAMPLE.parent)
    scenario = chosen(f"assessment={EXAMPLE.name}")
    assert scenario.services.assessment == str(EXAMPLE)
    (service,) = load_services(scenario, ("assessment",))
    assert type(service).__name__ == "Threshold"


def test_a_run_has_an_optional_role_if_that_has_an_implementation(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(roles, "_ROLES", {**roles._ROLES, "thermometer": roles._ROLES["search"]})
    without, with_it = (roles.workers(load_scenario("clean", more)) for more in ([], ["services.thermometer=mine.py"]))
    assert {*with_it} - {*without} == {"thermometer"}


def test_a_file_may_import_modules_of_its_folder(tmp_path: Path) -> None:
    (tmp_path / "module_of_mine.py").write_text(EXAMPLE.read_text(encoding="utf-8"))
    (tmp_path / "mine.py").write_text("from module_of_mine import create\n")
    assert create("assessment", str(tmp_path / "mine.py"), load_scenario("healthy")).role == "assessment"


def test_files_of_two_folders_import_their_own_modules_of_one_name(tmp_path: Path) -> None:
    scan = PluginKind("patterns", "exam.pattern", "scan")
    for folder in ("v1", "v2"):
        (tmp_path / folder / "package_of_mine").mkdir(parents=True)
        (tmp_path / folder / "package_of_mine" / "inner.py").write_text(f"value = '{folder}'\n")
        (tmp_path / folder / "helper_of_mine.py").write_text(f"value = '{folder}'\n")
        (tmp_path / folder / "later_of_mine.py").write_text(f"value = '{folder}'\n")
        text = "import helper_of_mine\nfrom package_of_mine import inner\ndef scan():\n    import later_of_mine\n"
        text += "    return helper_of_mine.value, inner.value, later_of_mine.value\n"
        (tmp_path / folder / "mine.py").write_text(text)
    for folder in ("v1", "v2", "v1"):
        assert scan.load(str(tmp_path / folder / "mine.py"))() == (folder,) * 3
    (tmp_path / "v1" / "helper_of_mine.py").write_text("value = 'changed'\n")
    assert scan.load(str(tmp_path / "v1" / "mine.py"))() == ("changed", "v1", "v1")


def test_a_missing_library_is_named_with_the_extra_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(_: object) -> None:
        raise ModuleNotFoundError("No module named 'mujoco'", name="mujoco")

    kind("robot").check_libraries("mujoco")
    palpate_plugins.missing_libraries.cache_clear()
    monkeypatch.setattr(palpate_plugins, "_installed", lambda name: name != "mujoco")
    monkeypatch.setattr("importlib.metadata.EntryPoint.load", fails)
    kind("robot").check("mujoco")
    for use in (kind("robot").check_libraries, kind("robot").load):
        with pytest.raises(PluginError, match=r"services\.robot = 'mujoco': needs mujoco, .* pip install 'palpate\[mujoco\]'"):
            use("mujoco")
    palpate_plugins.missing_libraries.cache_clear()
