"""The tissue as an FMU against the native tissue: the same numbers over a path, and over a whole recorded examination."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from examination import palpate_run

from palpate.environment import FIXED
from palpate.run.composed import load_services
from palpate.run.processes import compose_file
from palpate.run.roles import WORKERS
from palpate_bus.contract import Topic, contract
from palpate_bus.messages.codec import decode
from palpate_bus.messages.stamps import NS
from palpate_bus.runtime.composed import Composed
from palpate_bus.service import Service
from palpate_conductor.collector import Collector
from palpate_fmu.compiling import native
from palpate_fmu.export import build_scenario_fmu
from palpate_fmu.instance import FmuInstance
from palpate_models.patient.breathing import BreathingCurve
from palpate_models.patient.phantom import build_phantom
from palpate_models.scenario.load import load_scenario
from palpate_models.scenario.schema import Scenario
from palpate_tissue.backends.fmu.service import create as create_fmu
from palpate_tissue.backends.winkler.service import create as create_native
from palpate_tissue.backends.winkler.tissue import WinklerTissue
from palpate_tissue.surface import SkinSurface

BOUND = 1e-9
"""Relative difference allowed. Both add the same terms, in different orders: 1e-13 is what is measured."""
RADIUS_M = 0.015
STEP_S = 1e-3


def path(surface: SkinSurface) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Press, hold (relaxation), slide over the lesion, turn on the spot, withdraw, and wait: position and velocities."""
    x = np.concatenate((np.full(800, -0.09), np.linspace(-0.09, -0.01, 1600), np.full(1000, -0.01)))
    depth = np.concatenate((np.linspace(-0.003, 0.010, 400), np.full(2400, 0.010), np.linspace(0.010, -0.05, 600)))
    points = []
    for at, below in zip(x, depth, strict=True):
        under = surface.nearest(np.array((at, -0.055, 0.0)))
        points.append(under.position + (RADIUS_M - below) * under.normal)
    position = np.array(points)
    velocity = np.gradient(position, STEP_S, axis=0)
    spin = np.tile((0.2, -0.1, 0.5), (len(x), 1))
    return list(zip(position, velocity, spin, strict=True))


BREATHING = "phantom.breathing.kind=quiet"
FINE = "phantom.edge_m=0.0035"
STIFFENING = "phantom.stiffness.stiffening_per_m=80"
STRAIGHT_SOON = "phantom.stiffness.stiffening_per_m=600"
"""The modulus rises no further from a depth of 6.5 mm on."""
INVOLUNTARY = "phantom.guarding=[{centre_m: [-0.03, -0.04], kind: involuntary}]"
VOLUNTARY = "phantom.guarding=[{centre_m: [-0.03, -0.04], kind: voluntary}]"
PERSON = "phantom={kind: person, draw: {lumps: [2, 2]}, lesions: [{centre_m: [-0.05, -0.055], depth_m: 0.01}]}"


@pytest.mark.parametrize(
    "settings",
    [
        (),
        (BREATHING,),
        (FINE,),
        (STIFFENING,),
        (STRAIGHT_SOON, INVOLUNTARY),
        (STIFFENING, VOLUNTARY, BREATHING, FINE),
        (PERSON, BREATHING),
    ],
    ids=["default", "breathing", "fine mesh", "stiffening", "guarding", "all", "person"],
)
def test_force_torque_and_displacement_agree_over_a_sliding_path(settings: tuple[str, ...], tmp_path: Path) -> None:
    scenario = load_scenario("clean", settings)
    model = build_phantom(scenario.phantom, scenario.seed)
    tissue = WinklerTissue(model, scenario.phantom.stiffness, BreathingCurve(scenario.phantom.breathing, scenario.seed))
    motions = path(SkinSurface(model))
    if FINE in settings:
        motions = motions[:1500]
    wrenches = np.empty((len(motions), 2, 6))
    moved = largest = 0.0
    with FmuInstance(build_scenario_fmu(scenario, tmp_path / "abdomen.fmu", 3, [native()]), -STEP_S) as fmu:
        motion = fmu.port(["indenter_position", "indenter_velocity", "indenter_angular_velocity"])
        wrench, surface = fmu.port(["contact_force", "contact_torque"]), fmu.port(["surface_displacement"])
        for k, (p, v, w) in enumerate(motions):
            wrenches[k, 0] = np.concatenate(tissue.step(k * STEP_S, p, v, RADIUS_M, w))
            motion.values[:] = (*p, *v, *w)
            motion.push()
            fmu.step((k - 1) * STEP_S, STEP_S)
            wrenches[k, 1] = wrench.pull()
            assert abs(float(fmu.get("activation")) - tissue.activation) < BOUND
            if k % 20 == 0:
                moved = max(moved, float(np.abs(surface.pull() - tissue.inward).max()))
                largest = max(largest, float(np.abs(tissue.inward).max()))
    difference = np.abs(wrenches[:, 0] - wrenches[:, 1]).max(axis=0)
    scale = np.linalg.norm(wrenches[:, 0, :3], axis=1).max()
    assert scale > 2
    assert (VOLUNTARY in settings) == (tissue.activation < 1)
    assert largest > 0.005
    assert difference[:3].max() < BOUND * scale, difference
    assert difference[3:].max() < BOUND * scale * RADIUS_M, difference
    assert moved < BOUND * largest
    print(f"force {difference[:3].max() / scale:.1e}, displacement {moved / largest:.1e}, sub-steps {tissue.substeps}")


@dataclass
class Tape:
    """A tap that keeps the messages of some topics, by time [ns]."""

    topics: frozenset[str]
    kept: dict[str, dict[int, bytes]] = field(default_factory=dict)

    def __call__(self, topic: Topic, payload: bytes, stamp: int, _sequence: int) -> None:
        if topic.name in self.topics:
            self.kept.setdefault(topic.name, {})[stamp] = payload

    def messages(self, topic: str) -> Mapping[int, Any]:
        return {t: decode(payload, contract().topics[topic].type) for t, payload in self.kept[topic].items()}


class Playback:
    """An inbox with one topic's newest message."""

    def __init__(self) -> None:
        self.tool: Any = None

    def latest(self, topic: str) -> Any:
        return self.tool if topic == "sim/tool_state" else None


@dataclass(frozen=True)
class Examined:
    """What an examination gave."""

    collected: Any
    run_hash: str
    tape: Tape


def examine(scenario: Scenario, tissue: Service) -> Examined:
    """A whole examination in this process, with a tissue."""
    tape = Tape(frozenset({"sim/tool_state", "sim/contact_wrench", "sim/surface", "truth/indentation"}))
    collector = Collector()
    roles = tuple(role for role in WORKERS if role != "tissue")
    run = Composed([*load_services(scenario, roles), tissue, collector], taps=[tape])
    last = run.run(lambda: collector.collected.end_tick, 600 * NS)
    assert collector.collected.end_tick is not None, f"not finished after {last / NS} s"
    run.finish()
    return Examined(collector.collected, run.run_hash(), tape)


SETTINGS = ("exam.region_m=[0.05, 0.05]", "exam.centre_m=[-0.055, -0.055]", "camera.frames=5")


def _scenario() -> Scenario:
    return load_scenario("clean", SETTINGS, seed=3)


@pytest.fixture(scope="module")
def with_native() -> Examined:
    return examine(_scenario(), create_native(_scenario()))


@pytest.mark.slow
@pytest.mark.timeout(1500)
def test_a_recorded_examination_gives_the_same_wrench_and_surface(with_native: Examined) -> None:
    tape = with_native.tape
    fmu, inbox = create_fmu(_scenario()), Playback()
    fmu.start()
    wrenches, surfaces = tape.messages("sim/contact_wrench"), tape.messages("sim/surface")
    truths = tape.messages("truth/indentation")
    difference = scale = moved = 0.0
    for t, tool in tape.messages("sim/tool_state").items():
        inbox.tool = tool
        sent = fmu.step(t, inbox)  # type: ignore[arg-type]
        ours, theirs = (_vector(message.wrench.force) for message in (sent["sim/contact_wrench"], wrenches[t]))
        difference = max(difference, float(np.abs(ours - theirs).max()))
        scale = max(scale, float(np.abs(theirs).max()))
        if t in surfaces:
            moved = max(moved, float(np.abs(sent["sim/surface"].vertices - surfaces[t].vertices).max()))
        if t in truths:
            assert abs(sent["truth/indentation"].depth - truths[t].depth) < 1e-12
            assert sent["truth/indentation"].contacts == truths[t].contacts
    assert scale > 5
    assert difference < BOUND * scale
    assert moved <= np.spacing(np.float32(1.0))  # single precision on the bus
    print(f"force {difference / scale:.1e} of {scale:.1f} N over {len(wrenches)} steps, surface {moved:.1e} m")


@pytest.fixture(scope="module")
def with_fmu() -> Examined:
    return examine(_scenario(), create_fmu(_scenario()))


@pytest.mark.slow
@pytest.mark.timeout(1500)
def test_an_examination_with_the_fmu_has_the_same_findings(with_native: Examined, with_fmu: Examined) -> None:
    native_findings, findings = with_native.collected.findings.findings, with_fmu.collected.findings.findings
    assert len(findings) == len(native_findings) >= 1
    for found, expected in zip(findings, native_findings, strict=True):
        np.testing.assert_allclose(_vector(found.centroid), _vector(expected.centroid), atol=1e-4)
        assert found.ratio == pytest.approx(expected.ratio, rel=1e-2)
        assert found.area == pytest.approx(expected.area, rel=1e-2)


@pytest.mark.slow
@pytest.mark.timeout(1500)
def test_one_line_of_the_compose_file_puts_it_on_the_bus(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As a process of its own it gives, to the bit, what it gives in one process with all others, under the same environment."""
    fixed = {**os.environ, **FIXED}
    composed = subprocess.run([sys.executable, __file__], env=fixed, capture_output=True, text=True, timeout=900, check=True)
    text = compose_file().read_text(encoding="utf-8")
    line = "command: [python, -m, palpate.service, tissue]"
    assert text.count(line) == 1
    swapped = tmp_path / "docker-compose.yml"
    swapped.write_text(text.replace(line, "command: [python, -m, palpate.service, tissue, fmu]"), encoding="utf-8")
    monkeypatch.setenv("PALPATE_COMPOSE", str(swapped))
    finished = palpate_run("clean", tmp_path / "out", "--record", "none", "--seed", "3", settings=SETTINGS)
    assert finished.status == 0, finished.output
    assert "FMI 3.0" in (tmp_path / "out" / "logs" / "tissue.log").read_text(encoding="utf-8")
    assert finished.report["run_hash"] == composed.stdout.split()[-1]


def _vector(message: Any) -> np.ndarray:
    return np.array((message.x, message.y, message.z))


if __name__ == "__main__":
    print(examine(_scenario(), create_fmu(_scenario())).run_hash)
