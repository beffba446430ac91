"""Extras and dependency groups of pyproject.toml name exactly the libraries that their modules import."""

import ast
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from functools import cache
from importlib.metadata import requires
from pathlib import Path
from typing import Any

import pytest
from packaging.requirements import Requirement

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
EXTRAS: dict[str, list[str]] = PROJECT["project"]["optional-dependencies"]
GROUPS: dict[str, list[Any]] = PROJECT["dependency-groups"]
PACKAGES: dict[str, Path] = {
    Path(path).name: ROOT / path for path in PROJECT["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"]
}
BARE = ""
"""No extra: the dependencies of palpate itself."""

NAMES = {
    BARE: ("palpate_bus", "palpate_errors", "palpate_inputs", "palpate_plugins"),
    "run": (
        "palpate", "palpate_models.robot.urdf_arm", "palpate_robot.backends.lbr.emulator",
        "palpate_robot.backends.ros2_control.emulator", "palpate_robot.backends.emulated",
    ),
    "study": (
        "palpate.__init__",  # lazily imported names of the library
        "palpate.interface.studies", "palpate.study", "research.search.curves", "research.search.whole",
    ),
    "library": ("palpate.interface", "palpate.recording", "palpate.comparison", "palpate.twin", "palpate.search"),
    "fmu": ("palpate.fmu",),
    "dashboard": ("palpate.live.dashboard",),
    "bench": ("palpate.fuzz", "palpate_benchmarks", "palpate_validation", "palpate_reproduction"),
    "learn": ("research.search.learn",),
    "recordings group": ("palpate_bus.mcap_records", "palpate_bus.recordings"),
    "models group": ("palpate_models", "palpate_robot", "palpate_camera"),  # modules that all backends share
    "robot group": ("palpate_robot.backends.dart",),
    "robot-mujoco group": ("palpate_robot.backends.mujoco",),
    "robot-lbr group": tuple(
        f"palpate_robot.backends.{name}" for name in ("lbr", "ros2_control", "arm_port", "hardware", "watchdog")
    ),
    "tissue-elastic group": ("palpate_tissue.backends.elastic",),
    "tissue-fmu group": ("palpate_tissue.backends.fmu", "palpate_fmu"),
    "camera group": ("palpate_camera.backends.kinect",),
    "camera-replay group": ("palpate_camera.backends.replay",),
    "camera-ros group": ("palpate_camera.backends.ros",),
    "conductor group": ("palpate_conductor", "palpate_bus.security.keys"),
    **{
        f"{role} group": (f"palpate_{role}",)
        for role in ("tissue", "perception", "planning", "control", "assessment", "supervisor", "recorder", "search", "dashboard")
    },
}  # fmt: skip
"""Packages and modules by the extra, or the group of an image, that they need. The longest matching name counts."""
NEEDS = {name: need for need, names in NAMES.items() for name in names}
DISTRIBUTION = {
    "PIL": "pillow", "markupsafe": "jinja2", "pinocchio": "pin", "rerun": "rerun-sdk", "rerun_cli": "rerun-sdk",
    "sklearn": "scikit-learn", "stable_baselines3": "stable-baselines3", "robust_laplacian": "robust-laplacian",
    "yaml": "pyyaml", "zenoh": "eclipse-zenoh",
}  # fmt: skip
"""Distributions by the name of the import, where it differs."""
OPTIONAL = {"zenoh_ros2_sdk"}
"""Imported only if find_spec finds it; in no extra."""
ON_DEMAND = {
    "playwright": "dashboard",
    "palpate_fmu.reading.FmuError": "fmu",
    "palpate_fmu.reading.open_fmu": "fmu",
    "palpate_models.robot.urdf_arm.load_arm": "run",
    "palpate_models.robot.urdf_arm.read_arm": "run",
    "palpate_robot.backends.ros2_control.emulator.EmulatedPort": "run",
    "palpate_robot.plant.Plant": "run",
}
"""Imports of a single function, and the extra that its callers need."""
NOT_IMPORTED = {"bokeh", "example-robot-data", "stable-baselines3", "torch", "ziglang"}
"""Run as a program, imported by another library or by research, or data: Dask uses bokeh, training a policy torch."""


def need_of(module: str) -> str:
    """Return the extra or group of a module or of a name in one."""
    parts = module.split(".")
    return next(NEEDS[name] for n in range(len(parts), 0, -1) if (name := ".".join(parts[:n])) in NEEDS)


def lines(name: str) -> list[Any]:
    """Return the lines of an extra, of a group ("robot group"), or of the project's dependencies."""
    if name == BARE:
        dependencies: list[Any] = PROJECT["project"]["dependencies"]
        return dependencies
    return GROUPS[name.removesuffix(" group")] if name.endswith(" group") else EXTRAS[name]


def direct(name: str) -> set[str]:
    """Return the distributions that an extra or group names itself."""
    return {re.split(r"[<>=]", line)[0] for line in lines(name) if isinstance(line, str) and not line.startswith("palpate[")}


def included(name: str) -> set[str]:
    """Return an extra or group with those that it includes, directly or not."""
    inner: list[str] = []
    for line in lines(name):
        if isinstance(line, dict):
            inner.append(f"{line['include-group']} group")
        elif line.startswith("palpate["):
            inner += line[8:-1].split(",")
    return {name, BARE}.union(*map(included, inner))


def extra_with(name: str) -> str:
    """Return the extra that installs the libraries of a group."""
    if not name.endswith(" group"):
        return name
    return {"robot-mujoco": "mujoco", "tissue-fmu": "fmu", "dashboard": "dashboard"}.get(name.removesuffix(" group"), "run")


def libraries(name: str) -> set[str]:
    """Return the distributions that an extra or group installs."""
    return set().union(*map(direct, included(name)))


def imported(tree: ast.Module) -> Iterator[str]:
    """Yield the modules, or names in modules, that a file imports anywhere."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.Call) and getattr(node.func, "id", getattr(node.func, "attr", "")) == "import_module":
            yield from (word.value for word in node.args[:1] if isinstance(word, ast.Constant) and isinstance(word.value, str))


@cache
def needs() -> list[tuple[str, str, str]]:
    """Return (importing file, its extra or group, imported name) for everything outside the standard library."""
    found = []
    for package, folder in PACKAGES.items():
        for path in sorted(folder.rglob("*.py")):
            module = ".".join((package, *path.relative_to(folder).with_suffix("").parts))
            for name in set(imported(ast.parse(path.read_text(encoding="utf-8")))):
                top = name.partition(".")[0]
                if top not in sys.stdlib_module_names | OPTIONAL:
                    needing = next((ON_DEMAND[key] for key in (top, name) if key in ON_DEMAND), need_of(module))
                    found.append((str(path.relative_to(ROOT)), needing, name))
    return found


@pytest.mark.parametrize("need", sorted(set(NEEDS.values())))
def test_imports_are_installed(need: str) -> None:
    installed = libraries(need)
    for where, needing, name in needs():
        if needing == need:
            top = name.partition(".")[0]
            if top in PACKAGES:
                missing = libraries(need_of(name)) - installed
                assert not missing, f"{where} imports {name}, which needs {missing}; {need} does not install it"
            else:
                assert DISTRIBUTION.get(top, top) in installed, f"{where} imports {top}, which {need} does not install"


@pytest.mark.parametrize("name", [name for name in [BARE, *EXTRAS, *(f"{g} group" for g in GROUPS)] if direct(name)])
def test_nothing_is_installed_that_nothing_imports(name: str) -> None:
    image = [extra_with(name)] if name == "conductor group" else []  # its image has the command line
    used = {
        word.partition(".")[0]
        for _, need, word in needs()
        if need in image or name in included(need) | included(extra_with(need))
    }
    assert direct(name) <= {DISTRIBUTION.get(one, one) for one in used} | NOT_IMPORTED


def test_all_is_all_but_torch() -> None:
    assert included("all") == {*EXTRAS, BARE} - {"learn"}


def with_required(distributions: set[str]) -> set[str]:
    """Return distributions with all that they require."""
    found, left = set[str](), list(distributions)
    while left:
        name = re.sub(r"[-_.]+", "-", left.pop()).lower()
        if name not in found:
            found.add(name)
            required = map(Requirement, requires(name) or ())
            left += [line.name for line in required if line.marker is None or line.marker.evaluate({"extra": ""})]
    return found


def test_the_conductors_image_has_all_that_its_command_imports() -> None:
    words = "import sys; from importlib import import_module; import_module(sys.argv[1]); print(*sys.modules)"
    done = subprocess.run(
        [sys.executable, "-c", words, "palpate.run.conducting"], capture_output=True, text=True, check=True, timeout=120
    )
    has = with_required(libraries("conductor group"))
    tops = {name.partition(".")[0] for name in done.stdout.split()} - PACKAGES.keys()
    named = {DISTRIBUTION.get(top, top) for top in tops}
    others = set().union(*map(direct, EXTRAS)) - has
    assert "rerun-sdk" in others
    assert not named & others, f"the conductor's image does not install {', '.join(sorted(named & others))}"
