"""Files, environment and arguments of a role that may not know the patient do not depend on the patient's seed."""

import ast
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from palpate.run import composed
from palpate.run.group import one_per_process
from palpate.run.processes import LocalProcesses, compose_file, read_processes
from palpate.run.roles import OBSERVERS, workers, write_scenario_files
from palpate_bus.contract import contract
from palpate_conductor.outcome import Timing
from palpate_models.scenario.load import dump_scenario, load_scenario, view_of
from palpate_models.scenario.schema import Scenario

ROOT = Path(__file__).resolve().parents[2]
SEEDS = (11, 4711)
ALL_ROLES = ["exam.pattern=search"]
"""Settings with which every role takes part."""
ROLES = (*workers(load_scenario("poor_errors", ALL_ROLES)), *OBSERVERS)
UNKNOWING = tuple(role for role in ROLES if view_of(role) == "exam")
DRAWING = {"draw_errors", "draw_arm", "true_pose", "plant_input", "PlantInput"}


@dataclass(frozen=True)
class Handout:
    """Everything that a role is given at its start."""

    files: Mapping[str, bytes]
    """By name: the scenario file and all files of its folder."""
    environment: Mapping[str, str]
    arguments: Sequence[str]


Hand = Callable[[Scenario, Path], Mapping[str, Handout]]
"""The handouts of a run of a scenario, by role."""


class Unstarted(LocalProcesses):
    """Records what each process is given instead of starting it."""

    def _start(self, command: tuple[str, ...], environment: dict[str, str], path: Path) -> Any:
        file = Path(environment["PALPATE_SCENARIO"])
        files = {path.name: path.read_bytes() for path in file.parent.iterdir() if path.is_file()}
        listening = Path(environment["PALPATE_LISTEN"].partition("/")[2]).parent  # a folder of random name
        kept = {name: value.replace(str(listening), "/sockets") for name, value in environment.items()}
        return Handout(files, kept, command)


def distributed(scenario: Scenario, out: Path) -> Any:
    """Return the handouts of processes."""
    files = write_scenario_files(scenario, out)
    local = Unstarted(one_per_process(ROLES), out, files, Timing(), record="full")
    try:
        for process in read_processes(compose_file(), ROLES).values():
            local.start(process)
        return dict(local.running)
    finally:
        local.running.clear()
        local.stop()


def in_one_process(scenario: Scenario, out: Path) -> Any:
    """Return the handouts of services in one process: the arguments of `create`."""
    handouts = {}

    class StopError(Exception):
        """All services have been made."""

    def create(role: str, _: str, given: Scenario) -> Any:
        handouts[role] = Handout({"scenario": dump_scenario(given).encode()}, dict(os.environ), ())
        if len(handouts) == len(ROLES):
            raise StopError
        return None

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(composed, "create", create)
        with pytest.raises(StopError):
            write_scenario_files(scenario, out)
            composed.run_here(scenario, out, OBSERVERS, composed.ChildPlace(), lambda _: None)
    return handouts


def differences(hand: Hand, tmp_path: Path) -> dict[str, list[str]]:
    """Return the differences for each role between two patients who differ only in their seed."""
    one, other = (
        hand(load_scenario("poor_errors", ALL_ROLES, seed=seed), tmp_path / f"patient-{seed}-of-{hand.__name__}")
        for seed in SEEDS
    )
    found = {}
    for role in ROLES:
        a, b = one[role], other[role]
        changed = (a.files.items() ^ b.files.items()) | (a.environment.items() ^ b.environment.items())
        found[role] = sorted({name for name, _ in changed} | ({"arguments"} if a.arguments != b.arguments else set()))
    return found


@pytest.mark.parametrize("hand", [distributed, in_one_process])
def test_two_patients_who_differ_in_seed_alone_are_the_same_to_who_may_not_know(hand: Hand, tmp_path: Path) -> None:
    found = differences(hand, tmp_path)
    assert {role: found[role] for role in UNKNOWING} == {role: [] for role in UNKNOWING}
    assert all(found[role] for role in ROLES if role not in UNKNOWING), "these know the patient or the errors"


def test_all_but_tissue_plant_and_observers_may_not_know() -> None:
    assert set(ROLES) == set(contract().roles) - {"conductor"}
    assert set(UNKNOWING) == {"control", "planning", "perception", "assessment", "search", "supervisor"}


def test_files_of_roles_that_may_not_know_mention_no_secret() -> None:
    scenario = load_scenario("poor_errors", seed=4711)
    exam, plant = (dump_scenario(scenario, view) for view in ("exam", "plant"))
    assert not [word for word in ("4711", "lesions", "phantom", "poor", "errors", "paper") if word in exam]
    assert not [word for word in ("lesions", "phantom", "paper") if word in plant]
    assert "4711" in plant


@pytest.mark.parametrize("role", [role for role in contract().roles if role in UNKNOWING])
def test_roles_that_may_not_know_draw_no_errors(role: str) -> None:
    for path in (ROOT / "services" / role / f"palpate_{role}").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = {alias.name for alias in node.names} if isinstance(node, ast.Import | ast.ImportFrom) else set()
            module = node.module if isinstance(node, ast.ImportFrom) else ""
            assert "palpate_models.scenario.errors" not in {module, *names}, f"{path}:{node.lineno}"
            assert not names & DRAWING, f"{path}:{node.lineno}"
