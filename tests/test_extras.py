"""Each extra of pyproject.toml names the libraries that its role imports: no fewer, or its install would not run, and no more."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from functools import cache
from importlib.metadata import requires
from pathlib import Path

import pytest
from packaging.requirements import Requirement

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
EXTRAS: dict[str, list[str]] = PROJECT["project"]["optional-dependencies"]
ROOMS: dict[str, Path] = {
    Path(path).name: ROOT / path for path in PROJECT["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"]
}
BARE = ""
"""No extra: what palpate depends on in any case."""

EXTRA_OF = {
    "palpate": "run",
    "palpate.__init__": "study",  # names of the interface, which are imported when they are asked for
    "palpate.command_line": "cli",
    "palpate.interface": "library",
    "palpate.interface.studies": "study",
    "palpate.fmu": "fmu",
    "palpate.live.dashboard": "all",  # the command line on what the dashboard draws
    "palpate.live.viewing": "all",
    "palpate.fuzz": "fuzz",
    "palpate.search": "library",
    "palpate.search.curves": "study",
    "palpate.search.environment": "learn-env",
    "palpate.search.learn": "learn",
    "palpate.search.speed": "learn-env",
    "palpate.search.whole": "study",
    "palpate.study": "study",
    "palpate_bus": BARE,
    "palpate_bus.recordings": "recordings",
    "palpate_bus.security.keys": "secure",
    "palpate_bus.testing.strategies": "fuzz",
    "palpate_models": "models",
    "palpate_planning.placement.redundancy": "planning",
    "palpate_planning.placement.inverse_kinematics": "planning",
    "palpate_planning.placement.symbolic": "planning",
    "palpate_robot": "models",  # what its backends share
    "palpate_robot.backends.dart": "robot",
    "palpate_robot.backends.mujoco": "robot-mujoco",
    "palpate_robot.backends.lbr": "robot-lbr",
    "palpate_robot.backends.lbr.emulator": "all",
    "palpate_tissue": "tissue",
    "palpate_tissue.backends.elastic": "tissue-elastic",
    "palpate_tissue.backends.fmu": "tissue-fmu",
    "palpate_camera": "models",  # what its backends share
    "palpate_camera.backends.kinect": "camera",
    "palpate_camera.backends.replay": "camera-replay",
    "palpate_camera.backends.ros": "camera-ros",
    "palpate_perception": "perception",
    "palpate_planning": "planning",
    "palpate_control": "control",
    "palpate_assessment": "assessment",
    "palpate_supervisor": "supervisor",
    "palpate_conductor": "conductor",
    "palpate_recorder": "recorder",
    "palpate_search": "search",
    "palpate_dashboard": "dashboard",
    "palpate_fmu": "fmu",
    "palpate_benchmarks": "benchmarks",
    "palpate_validation": "benchmarks",
    "palpate_reproduction": "benchmarks",
}
"""The extra that a package or module needs; the longest name that fits counts."""
DISTRIBUTION = {
    "PIL": "pillow",
    "libusb_package": "libusb-package",
    "markupsafe": "jinja2",
    "open3d": "open3d-cpu",
    "pinocchio": "pin",
    "pydantic_settings": "pydantic-settings",
    "rerun": "rerun-sdk",
    "sklearn": "scikit-learn",
    "stable_baselines3": "stable-baselines3",
    "rerun_cli": "rerun-sdk",
    "robust_laplacian": "robust-laplacian",
    "yaml": "pyyaml",
    "zenoh": "eclipse-zenoh",
}
"""Distributions whose name is not that of what is imported."""
OPTIONAL = {"zenoh_ros2_sdk"}
"""Looked for with find_spec before they are imported: a fuzzer and a client to compare with, in no extra."""
WHEN_ASKED_FOR = {"playwright": "picture", "palpate_robot.plant.Plant": "robot"}
"""Imported by one function alone, which only those call who have the extra that is named here."""
NOT_IMPORTED = {"bokeh", "ziglang"}
"""Run as a program, or by another library: Dask draws its dashboard with bokeh."""


def extra_of(module: str) -> str:
    """The extra of a module or of a name in one."""
    parts = module.split(".")
    return next(EXTRA_OF[name] for n in range(len(parts), 0, -1) if (name := ".".join(parts[:n])) in EXTRA_OF)


def own_lines(extra: str) -> set[str]:
    """Distributions that an extra names itself."""
    lines = PROJECT["project"]["dependencies"] if extra == BARE else EXTRAS[extra]
    return {re.split(r"[<>=]", line)[0] for line in lines if not line.startswith("palpate[")}


def with_named(extra: str) -> set[str]:
    """An extra and those that it names, theirs too, and what is installed in any case."""
    named = [inner for line in EXTRAS.get(extra, ()) if line.startswith("palpate[") for inner in line[8:-1].split(",")]
    return {extra, BARE}.union(*map(with_named, named))


def imported(tree: ast.Module) -> Iterator[str]:
    """Modules, or names in modules, that a file imports, at its top or in a function."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.Call) and getattr(node.func, "id", getattr(node.func, "attr", "")) == "import_module":
            yield from (word.value for word in node.args[:1] if isinstance(word, ast.Constant) and isinstance(word.value, str))


@cache
def needs() -> list[tuple[str, str, str]]:
    """(the importing file, its extra, what it imports) for everything beyond the standard library."""
    found = []
    for package, folder in ROOMS.items():
        for path in sorted(folder.rglob("*.py")):
            module = ".".join((package, *path.relative_to(folder).with_suffix("").parts))
            for name in set(imported(ast.parse(path.read_text(encoding="utf-8")))):
                top = name.partition(".")[0]
                if top not in sys.stdlib_module_names | OPTIONAL:
                    needing = next((WHEN_ASKED_FOR[key] for key in (top, name) if key in WHEN_ASKED_FOR), extra_of(module))
                    found.append((str(path.relative_to(ROOT)), needing, name))
    return found


@pytest.mark.parametrize("extra", sorted(set(EXTRA_OF.values())))
def test_an_extra_has_what_its_role_imports(extra: str) -> None:
    installed = with_named(extra)
    libraries = set().union(*map(own_lines, installed))
    for where, needing, name in needs():
        if needing == extra:
            top = name.partition(".")[0]
            if top in ROOMS:
                assert extra_of(name) in installed, f"{where} imports {name}, which needs palpate[{extra_of(name)}]"
            else:
                assert DISTRIBUTION.get(top, top) in libraries, f"{where} imports {top}, which palpate[{extra}] does not install"


@pytest.mark.parametrize("extra", [BARE, *(name for name in EXTRAS if own_lines(name))])
def test_an_extra_has_nothing_that_nothing_imports(extra: str) -> None:
    used = {name.partition(".")[0] for _, needing, name in needs() if extra in with_named(needing)}
    assert own_lines(extra) <= {DISTRIBUTION.get(name, name) for name in used} | NOT_IMPORTED


def test_all_is_all_but_torch() -> None:
    assert with_named("all") == {*EXTRAS, BARE} - {"learn"}


def with_required(distributions: set[str]) -> set[str]:
    """Distributions, and all that they require themselves."""
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
    has = with_required(set().union(*map(own_lines, with_named("conductor"))))
    tops = {name.partition(".")[0] for name in done.stdout.split()} - ROOMS.keys()
    named = {DISTRIBUTION.get(top, top) for top in tops}
    others = set().union(*(own_lines(extra) for extra in EXTRAS)) - has
    assert "mcap" in others
    assert not named & others, f"palpate[conductor] does not install {', '.join(sorted(named & others))}"
