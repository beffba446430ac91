"""`python -m palpate_tissue.backends.elastic.prepare SCENARIO [--set a.b=c] [--seed N]`: computes the cached compliance.

For machines on which that takes longer than the start-up time-out of a run.
"""

import argparse
import sys
import time

from palpate_errors import UserError
from palpate_models.numerics.cache import folder
from palpate_models.scenario.load import load_scenario
from palpate_tissue.backends.elastic.service import create


def main() -> None:
    """Print the time taken; status 2 for an unusable scenario."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenario")
    parser.add_argument("--set", action="append", default=[], dest="settings", metavar="a.b=c")
    parser.add_argument("--seed", type=int)
    given = parser.parse_args()
    begin = time.perf_counter()
    try:
        create(load_scenario(given.scenario, given.settings, given.seed))
    except UserError as error:
        print(error, file=sys.stderr)
        sys.exit(2)
    print(f"{given.scenario}: ready after {time.perf_counter() - begin:.1f} s, cached in {folder()}")


if __name__ == "__main__":
    main()
