"""Memory over repeated examinations: table and figure.

palpate run --repeat 200 --record none --out FOLDER
python -m research.soak FOLDER [FOLDER ...] --out soak.png
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from matplotlib import colormaps
from matplotlib.figure import Figure

from palpate.console import refuse
from palpate.run.repeat import Growth, ProcessSample, Soak, read_growths, read_samples

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


def draw(soaks: dict[str, list[ProcessSample]], path: Path) -> None:
    """Writes a PNG: for each soak, by its name, the most memory and open files of every role in each examination, and its memory
    in the course of the examination in the middle.
    """
    figure = Figure(figsize=(11.0, 3.2 * len(soaks)), layout="constrained")
    for (name, samples), panels in zip(soaks.items(), figure.subplots(len(soaks), 3, squeeze=False), strict=True):
        memory, within, files = panels
        middle = 1 + max(sample.number for sample in samples) // 2
        for (role, each), colour in zip(Soak.of(samples).most.items(), colormaps["tab20"].colors, strict=False):  # type: ignore[attr-defined]
            hours = [most.at_s / HOUR_S for most in each.values()]
            memory.plot(hours, [most.rss_mb for most in each.values()], ".-", color=colour, lw=0.8, ms=3)
            files.plot(hours, [most.descriptors for most in each.values()], ".-", color=colour, lw=0.8, ms=3, label=role)
            course = [(sample.at_s, sample.rss_mb) for sample in samples if (sample.role, sample.number) == (role, middle)]
            if course:
                at_s, rss_mb = zip(*course, strict=True)
                within.plot([second - at_s[0] for second in at_s], rss_mb, color=colour, lw=1.0)
        memory.set(title=f"{name}: memory [MB]", xlabel="time [h]")
        within.set(title=f"in examination {middle}: memory [MB]", xlabel="time [s]")
        files.set(title="open files", xlabel="time [h]")
        files.legend(fontsize=7, frameon=False, loc="upper left", bbox_to_anchor=(1.0, 1.0))
        for panel in panels:
            panel.set_ylim(0, None)
    figure.savefig(path, dpi=110, metadata={"Software": None})


def _ended(samples: list[ProcessSample], growths: list[Growth]) -> list[ProcessSample]:
    """Those of the examinations that came to their end."""
    last = max(growth.examinations for growth in growths)
    return [sample for sample in samples if sample.number <= last]


def main(
    folders: Annotated[list[Path], typer.Argument(help="Folders of palpate run --repeat; their names are those in the figure.")],
    out: Annotated[Path, typer.Option(help="Where the figure goes.")] = Path("soak.png"),
) -> None:
    """Prints how the memory of each role grows from examination to examination, and draws it."""
    try:
        growths = {folder.name: read_growths(folder) for folder in folders}
        soaks = {folder.name: _ended(read_samples(folder), growths[folder.name]) for folder in folders}
        draw(soaks, out)
    except (OSError, ValueError) as error:
        refuse(error)
    for folder in folders:
        print(f"{folder.name}\n\n{growth_table(growths[folder.name])}\n")
    print(out)


if __name__ == "__main__":
    typer.run(main)
