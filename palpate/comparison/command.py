"""`palpate compare`."""

from pathlib import Path
from typing import Annotated

import typer

from palpate.console import SteadyConsole, number, output_folder, print_json, say, table


def compare(
    a: Annotated[Path, typer.Argument(metavar="A", help="Results folder of assess or run, a recording, or a table of outcomes.")],
    b: Annotated[Path | None, typer.Argument(metavar="B", help="The other palpation of the same body.")] = None,
    mapping: Annotated[Path | None, typer.Option("--mapping", "-m", help="Mapping of recordings.")] = None,
    out: Annotated[Path, output_folder("Folder of compare.json and compare.png.", "--out", "-o")] = Path("compare"),
    register: Annotated[
        bool | None, typer.Option("--register/--no-register", help="Move B onto A; by default where their surfaces disagree.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print compare.json.")] = False,
) -> None:
    """Compare two palpations of one body, recorded or simulated: map against map, band, findings.

    Without B, A is a table of outcomes of several bodies, with the columns body, real and simulated: sim-to-real figures.

    [bold]Examples[/]

      palpate compare first/ again/                   two results folders

      palpate compare first/ probes.csv -m probes.yaml   the forces of a recording inside the band of a map

      palpate compare outcomes.csv                    real against simulated outcomes
    """
    from json import dumps

    from palpate.comparison import compare as comparing
    from palpate.comparison.compare import draw_outcomes, read_outcomes, sim_to_real
    from palpate.report.files import write_text

    if b is None:
        pairs = read_outcomes(a)
        outcome = sim_to_real(*pairs)
        draw_outcomes(out / "compare.png", *pairs)
        figures = outcome._asdict()
    else:
        first = comparing.read_palpated(a, mapping)
        second = comparing.read_palpated(b, mapping, first.depth_m)
        for text in (*first.faults, *second.faults):
            say(text)
        compared = comparing.compare(first, second, register)
        comparing.draw(out / "compare.png", compared)
        figures = compared.figures._asdict()
    write_text(out / "compare.json", dumps(figures, indent=2) + "\n")
    if as_json:
        print_json(figures)
        return
    rows = table("figure", ">value", ">90 % interval")
    for name, value in figures.items():
        band = figures.get(f"{name}_90")
        if (name.endswith("_90") and name.removesuffix("_90") in figures) or isinstance(value, list):
            continue
        shown = "" if isinstance(value, tuple) else str(value) if isinstance(value, bool) else number(value)
        band = value if isinstance(value, tuple) else band
        rows.add_row(name.removesuffix("_90"), shown, "" if band is None else f"{number(band[0])} to {number(band[1])}")
    console = SteadyConsole()
    console.print(rows)
    console.print(f"written to {out}: compare.json, compare.png", soft_wrap=True)
