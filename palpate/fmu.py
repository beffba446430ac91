"""`palpate fmu`: builds, inspects and simulates FMUs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.text import Text

from palpate.apart import run_guarded
from palpate.console import CaseDisplay, SteadyConsole, refuse, table, wide_console
from palpate.run.options import Settings

if TYPE_CHECKING:
    from palpate_models.numerics.frames import Array
    from palpate_models.scenario.schema import Scenario

DENSE = 2000
"""Continuous states up to which a dense Jacobian is practical (32 MB)."""
NAMES_CHECKED = 1000
"""Variables up to which names are checked against the naming convention: FMPy takes milliseconds per name."""
MESHES = (".obj", ".stl", ".ply")

app = typer.Typer(name="fmu", help="Export the abdomen as an FMU; inspect and simulate any FMU.", no_args_is_help=True)


def _scenario(name: str, settings: list[str]) -> Scenario:
    """Return the scenario of a name or file, or the default scenario with a mesh as its phantom."""
    from palpate_models.patient.schema import Phantom
    from palpate_models.scenario.load import ScenarioError, load_scenario
    from palpate_models.scenario.schema import Scenario

    if Path(name).suffix.lower() in MESHES:
        if settings:
            raise ScenarioError(f"{name}: --set needs a scenario: name one with phantom.kind: mesh and phantom.mesh: {name}")
        return Scenario(name=Path(name).stem, phantom=Phantom(kind="mesh", mesh=name))
    return load_scenario(name, settings)


@app.command()
def build(
    phantom: Annotated[str, typer.Argument(help="Name or file of a scenario, or a mesh (OBJ, STL, PLY).")] = "clean",
    out: Annotated[Path, typer.Option("--out", "-o", help="The FMU to write.")] = Path("abdomen.fmu"),
    fmi: Annotated[int, typer.Option(min=2, max=3, help="FMI version; version 2 has only a sample of the surface.")] = 3,
    only: Annotated[
        list[str] | None,
        typer.Option("--platform", metavar="NAME", help="Platform, such as x86_64-linux; may be repeated. By default all."),
    ] = None,
    settings: Settings = None,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Print errors only.")] = False,
) -> None:
    """Write the abdomen as an FMU with sources and cross-compiled binaries."""
    from palpate_fmu.compiling import platforms
    from palpate_fmu.export import build_scenario_fmu

    console = SteadyConsole(stderr=True)
    names = [platform.tuple_3 for platform in platforms(fmi, only)]
    scenario = _scenario(phantom, settings or [])
    with CaseDisplay(console, quiet or not console.is_terminal, "platforms") as display:

        def compiling(name: str) -> None:
            display.show(names.index(name), len(names), f"compiling for {name}: about a minute the first time")

        build_scenario_fmu(scenario, out, fmi, names, compiling=compiling)
    if not quiet:
        size = f"{out.stat().st_size / 1e6:.1f} MB"
        console.print(f"{out}: FMI {fmi}.0, {size}, for {', '.join(names)}", soft_wrap=True)


def _states(count: int) -> str:
    """Return the number of continuous states of model exchange as text, with advice when a dense Jacobian is too large."""
    number = f"continuous states: {count}"
    if count <= DENSE:
        return number
    reason = f"a solver with a dense Jacobian, such as FMPy's CVode, needs {8e-6 * count**2:.0f} MB for it"
    return f"{number}: {reason}; use solver='Euler' with steps of 1 ms, or a coarser mesh (--set phantom.edge_m=0.02)"


@app.command()
def info(file: Annotated[Path, typer.Argument(help="An FMU.")]) -> None:
    """Show an FMU's interface, variables and platforms."""
    import fmpy

    from palpate_fmu.reading import binary_folders, read_description, read_variables

    console = SteadyConsole()
    description, findings = read_description(file)
    platforms = binary_folders(file)
    kinds = [kind for kind in ("coSimulation", "modelExchange", "scheduledExecution") if getattr(description, kind, None)]
    console.print(Text.assemble((description.modelName, "bold"), f" FMI {description.fmiVersion}, {', '.join(kinds)}"))
    console.print(f"{description.description or ''}\nplatforms: {', '.join(platforms) or 'none (sources only)'}")
    console.print(_states(int(description.numberOfContinuousStates or 0)), soft_wrap=True)
    rows = table("variable", "shape", "type", "causality", "unit", "range", "description")
    for v in read_variables(description).values():
        bounds = "" if v.low is None and v.high is None else f"{v.low or ''} .. {v.high or ''}"
        shape = " x ".join(map(str, v.shape))
        rows.add_row(v.name, shape, v.type, f"{v.causality} ({v.variability})", v.unit or "", bounds, v.doc or "")
    wide_console(150).print(rows)
    names = len(description.modelVariables) <= NAMES_CHECKED
    verdict = "valid" if names else f"valid ({len(description.modelVariables)} names not parsed)"
    try:
        if not findings:
            fmpy.read_model_description(str(file), validate_variable_names=names, validate_model_structure=True)
    except Exception as error:  # FMPy raises many kinds for an FMU with findings
        findings = getattr(error, "problems", (str(error),))
    verdict = "\n".join(("findings of the validator, which do not prevent its use:", *findings)) if findings else verdict
    console.print(verdict)


@app.command()
def simulate(
    file: Annotated[Path, typer.Argument(help="An FMU; an abdomen is probed, any other FMU is run without inputs.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="PNG to write; a CSV is written next to it.")] = Path("probing.png"),
    at: Annotated[tuple[float, float], typer.Option(help="Position of the press in the abdomen frame, in metres.")] = (0.0, 0.05),
    depth: Annotated[float, typer.Option(min=0.001, max=0.03, help="Depth of the press, in metres.")] = 0.010,
    speed: Annotated[float, typer.Option(min=0.001, max=0.2, help="Speed of the press, in m/s.")] = 0.02,
    hold: Annotated[float, typer.Option(min=0, max=60, help="Duration of the hold, in seconds.")] = 1.0,
) -> None:
    """Press into an abdomen, hold, withdraw, and plot force against depth; run any other FMU and plot its outputs."""
    from palpate_fmu.compiling import native
    from palpate_fmu.instance import FmuInstance
    from palpate_fmu.probing import plot_probing, probe, run_and_plot
    from palpate_fmu.reading import FmuError

    console = SteadyConsole(stderr=True)

    def perform() -> tuple[Array | None, Sequence[str]]:
        with FmuInstance(file) as fmu:
            abdomen = {"indenter_position", "indentation_depth", "normal_force"} <= fmu.variables.keys()
            rows = probe(fmu, at, depth, speed, hold) if abdomen else None
        return rows, () if abdomen else run_and_plot(file, out)

    try:
        rows, names = run_guarded(str(file), perform, math.inf)
    except FmuError as error:
        refuse(f"{error} (this machine is {native()})")
    if rows is None:
        console.print(f"{out}: {', '.join(names)}")
        return
    plot_probing(rows, out, f"{file.name} at ({1e3 * at[0]:.0f}, {1e3 * at[1]:.0f}) mm")
    console.print(f"{out}: maximum force {rows[:, 2].max():.2f} N at {1e3 * rows[:, 1].max():.1f} mm")
