"""Renew the references of all services from one short examination: `python tests/commands/make_references.py`.

Needed after a change of a message type or of the inputs. If only the output of a service was meant to change,
`palpate replay REFERENCE --service ROLE --update-refs REFERENCE` is enough.
"""

import subprocess
import sys
import tempfile
from pathlib import Path

from palpate.replay.golden import make_reference, prepare
from palpate_bus.messages import NS

FOLDER = Path(__file__).parent / "references"
SETTINGS = (
    "exam.region_m=[0.03, 0.03]", "exam.centre_m=[-0.055, -0.055]", "phantom.edge_m=0.02", "phantom.lesions.0.contrast=2",
    "camera.frames=2", "camera.width_px=160", "camera.height_px=120", "camera.focal_px=146",
)  # fmt: skip
"""A small examination with small messages: a coarse abdomen and a camera of few pixels."""
SEARCH = ("exam.region_m=[0.06, 0.06]", "exam.pattern=search", "exam.budget.presses=4")
"""Additional settings of the examination that searches."""
CUTS = {
    "robot": (0.0, 0.1),
    "control": (29.0, 0.1),
    "tissue": (28.66, 0.1),  # from the air, since a tissue that begins deformed recoils
    "planning": (0.0, 3.0),
    "supervisor": (28.5, 1.0),
    "assessment": (31.0, 2.0),
    "camera": (0.0, 1.2),
    "perception": (0.0, 1.5),
    "search": (0.0, 60.0),
}
"""The part of the run that a service must reproduce: begin and length [s]."""


def main() -> None:
    """Run the examinations and cut the references from them."""
    with tempfile.TemporaryDirectory(prefix="palpate-references-") as folder:
        examine(Path(folder, "scan"), SETTINGS)
        examine(Path(folder, "search"), (*SETTINGS, *SEARCH))
        for role, (begin, length) in CUTS.items():
            run = Path(folder, "search" if role == "search" else "scan")
            target = FOLDER / f"{role}.mcap"
            make_reference(prepare(run, role), target, round(begin * NS), round((begin + length) * NS))
            print(f"{target}: {target.stat().st_size} bytes")


def examine(folder: Path, settings: tuple[str, ...]) -> None:
    """Run an examination and record all of it."""
    palpate = str(Path(sys.executable).with_name("palpate"))
    words = [word for setting in settings for word in ("--set", setting)]
    command = [palpate, "run", "clean", "--composed", "--record", "full", "--quiet", "--out", str(folder), *words]
    subprocess.run(command, check=True)


if __name__ == "__main__":
    main()
