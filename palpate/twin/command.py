"""`palpate fit`."""

from pathlib import Path
from typing import Annotated

import typer

from palpate.console import output_folder


def fit(
    recording: Annotated[Path, typer.Argument(metavar="RECORDING", help="CSV, Parquet, MCAP or rosbag2; folder of a run.")],
    mapping: Annotated[Path | None, typer.Option("--mapping", "-m", help="Its mapping, as for `palpate assess`.")] = None,
    out: Annotated[Path, output_folder("Folder of twin.yaml, twin.csv, twin.png and twin.json.", "--out", "-o")] = Path("twin"),
    elastic: Annotated[bool, typer.Option("--elastic", help="Fit Young's modulus, for the elastic tier.")] = False,
    thickness_m: Annotated[float, typer.Option(min=0.005, max=0.5, help="Of the body in metres, for the elastic tier.")] = 0.05,
    as_json: Annotated[bool, typer.Option("--json", help="Print twin.json.")] = False,
) -> None:
    """Fit a twin to a recording: a simulated patient with its surface, stiffness and lumps.

    A tenth of the places is held out, to measure how well the twin reproduces forces.

    [bold]Examples[/]

      palpate fit probes.csv -m probes.yaml -o twin     then palpate run twin/twin.yaml

      palpate fit bag -m bag.yaml --elastic
    """
    from json import dumps

    from palpate.console import print_json, say
    from palpate.recording.assessed import collect_assessed
    from palpate.recording.read import read_recording
    from palpate.report.evidence import map_of
    from palpate.report.files import write_text
    from palpate.twin.fit import write_twin

    read = read_recording(recording, mapping)
    for fault in read.faults:
        say(fault.text)
    message = collect_assessed(read).stiffness_map
    found = None if message is None else map_of(message)
    quality = write_twin(read, out, found, elastic, thickness_m)
    figures = quality._asdict()
    write_text(out / "twin.json", dumps(figures, indent=2) + "\n")
    if as_json:
        print_json(figures)
        return
    print(
        f"{quality.held_out} of {quality.presses} places held out: force within {100 * quality.error:.1f} % RMS, at the maximum "
        f"depth {100 * quality.error_at_depth:.1f} % (if uniform: {100 * quality.variation:.1f} %); {quality.lumps} lumps"
    )
    print(f"written to {out}: twin.yaml, twin.csv, twin.png, twin.json; next: palpate run {out / 'twin.yaml'}")
