"""True force and depth of examinations whose force sensor lies before the first touch: docs/frozen_sensor.csv and its figure.

Run: `python -m research.frozen_sensor FROM TO NAME=FOLDER...`, times in seconds; each FOLDER is of `palpate run --record full`.
"""

import sys
from pathlib import Path

import pandas as pd
from matplotlib.figure import Figure

from palpate_bus.contract import contract
from palpate_bus.messages import NS, codec, nanoseconds
from palpate_bus.recordings import open_recording

TOPIC = "truth/indentation"


def rows(folder: Path, begin_s: float, end_s: float) -> pd.DataFrame:
    """Return time [s], true force [N] and true depth [mm] every 40 ms."""
    recording = open_recording(folder / "recording_mcap")
    values = [codec.decode(message.payload, contract().topics[TOPIC].type) for message in recording.messages((TOPIC,))]
    found = pd.DataFrame(
        {
            "t_s": [nanoseconds(value.header.stamp) / NS for value in values],
            "force_N": [round(value.normal_force, 2) for value in values],
            "depth_mm": [round(value.depth * 1e3, 2) for value in values],
        }
    )
    return found[found.t_s.between(begin_s, end_s)][::4]


def main() -> None:
    """Write the data and the figure."""
    begin_s, end_s = map(float, sys.argv[1:3])
    runs = {name: rows(Path(folder), begin_s, end_s) for name, folder in (run.split("=", 1) for run in sys.argv[3:])}
    pd.concat(runs, names=["run"]).reset_index("run").to_csv("docs/frozen_sensor.csv", index=False)
    shown = Figure(figsize=(8, 4.5), layout="constrained")
    force, depth = shown.subplots(2, sharex=True)
    for name, run in runs.items():
        force.plot(run.t_s, run.force_N, label=f"{name}: {run.force_N.max():.1f} N")
        depth.plot(run.t_s, run.depth_mm.clip(lower=-30.0))
    force.axhline(15.0, color="grey", linestyle=":")
    force.set_ylabel("true force [N]")
    depth.set_ylabel("depth below the true skin [mm]")
    depth.set_xlabel("simulated time [s]")
    force.legend(frameon=False)
    shown.savefig("docs/images/frozen_sensor.png", dpi=110)


if __name__ == "__main__":
    main()
