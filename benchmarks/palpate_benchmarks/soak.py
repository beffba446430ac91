"""What examination after examination leaves in memory: the table and the figure of soaks.

palpate run --repeat 200 --record none --out FOLDER
python -m palpate_benchmarks.soak FOLDER [FOLDER ...] --out soak.png
"""

from __future__ import annotations

from itertools import cycle
from pathlib import Path
from typing import Annotated

import typer
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from palpate.command_line import refuse
from palpate.run.repeat import Growth, Most, Soak

HOUR_S = 3600.0


def growth_table(growths: list[Growth]) -> str:
    """Markdown, a role a row."""
    rows = [
        "| role | examinations | most memory [MB] | growth [% an hour] | open files, first and last |",
        "|---|---|---|---|---|",
    ]
    for growth in sorted(growths, key=lambda growth: -growth.highest_mb):
        grown = (
            "" if growth.percent_an_hour is None else f"{growth.percent_an_hour:+.2f} ({growth.low:+.2f} to {growth.high:+.2f})"
        )
        first, last = growth.descriptors
        rows.append(f"| {growth.role} | {growth.examinations} | {growth.highest_mb:.0f} | {grown} | {first}, {last} |")
    return "\n".join(rows)


def draw(soaks: dict[str, Soak], path: Path) -> None:
    """Writes a PNG: for each soak, by its name, the memory and the open files of every role, the most in each examination."""
    figure = Figure(figsize=(8.0, 3.0 * len(soaks)), layout="constrained")
    for (name, soak), (memory, files) in zip(soaks.items(), figure.subplots(len(soaks), 2, squeeze=False), strict=True):
        for (role, each), colour in zip(soak.most.items(), cycle(colormaps["tab10"].colors), strict=False):  # type: ignore[attr-defined]
            _draw_role(memory, files, list(each.values()), role, colour)
        memory.set(title=f"{name}: memory [MB]", ylim=(0, None), xlabel="time [h]")
        files.set(title="open files", ylim=(0, None), xlabel="time [h]")
        files.legend(fontsize=7, frameon=False, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    figure.savefig(path, dpi=110, metadata={"Software": None})


def _draw_role(memory: Axes, files: Axes, each: list[Most], role: str, colour: tuple[float, ...]) -> None:
    hours = [most.at_s / HOUR_S for most in each]
    memory.plot(hours, [most.rss_mb for most in each], ".-", color=colour, lw=0.8, ms=3)
    files.plot(hours, [most.descriptors for most in each], ".-", color=colour, lw=0.8, ms=3, label=role)


def main(
    folders: Annotated[list[Path], typer.Argument(help="Folders of palpate run --repeat; their names are those in the figure.")],
    out: Annotated[Path, typer.Option(help="Where the figure goes.")] = Path("soak.png"),
) -> None:
    """Prints how the memory of each role grows from examination to examination, and draws it."""
    try:
        soaks = {folder.name: Soak.read(folder) for folder in folders}
        draw(soaks, out)
    except (OSError, ValueError) as error:
        refuse(error)
    for name, soak in soaks.items():
        print(f"{name}\n\n{growth_table(soak.growths())}\n")
    print(out)


if __name__ == "__main__":
    typer.run(main)
