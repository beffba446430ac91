"""`python -m palpate_tissue`: the tissue as a process of its own."""

from palpate_bus.run import main
from palpate_models.load import load_scenario
from palpate_tissue.backends.winkler.service import create

if __name__ == "__main__":
    main("tissue", create, load_scenario)
