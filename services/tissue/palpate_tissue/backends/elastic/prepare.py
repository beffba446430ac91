"""`python -m palpate_tissue.backends.elastic.prepare SCENARIO [--set a.b=c] [--seed N]`: computes what a run would wait for.

For machines on which that takes longer than a run waits for its services to start.
"""

from __future__ import annotations

import argparse
import sys
import time

from palpate_models.numerics.cache import folder
from palpate_models.scenario.load import ScenarioError, load_scenario
from palpate_tissue.backends.elastic.compliance import SizeError
from palpate_tissue.backends.elastic.service import create


def main() -> None:
    """Prints how long it took; status 2 for a scenario that cannot be used."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenario")
    parser.add_argument("--set", action="append", default=[], dest="settings", metavar="a.b=c")
    parser.add_argument("--seed", type=int)
    words = parser.parse_args()
    begin = time.perf_counter()
    try:
        create(load_scenario(words.scenario, words.settings, words.seed))
    except (ScenarioError, SizeError) as error:
        print(error, file=sys.stderr)
        sys.exit(2)
    print(f"{words.scenario}: ready after {time.perf_counter() - begin:.1f} s, kept in {folder()}")


if __name__ == "__main__":
    main()
