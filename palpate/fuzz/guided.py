"""One target guided by coverage, with atheris: `python -m palpate.fuzz.guided TARGET [libFuzzer options]`.

A process of its own, since libFuzzer ends its process. Needs `atheris` (Linux, Python up to 3.13).
"""

from __future__ import annotations

import sys

import atheris

with atheris.instrument_imports(include=["palpate_bus", "palpate_models"]):
    from palpate.fuzz.fuzz import choose


def main() -> None:
    """Fuzzes; ends the process."""
    (target,) = choose([sys.argv[1].replace("[", "[[]")])
    atheris.Setup([sys.argv[0], *sys.argv[2:]], atheris.instrument_func(target.check))
    atheris.Fuzz()


if __name__ == "__main__":
    main()
