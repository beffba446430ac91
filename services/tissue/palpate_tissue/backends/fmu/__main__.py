"""`python -m palpate_tissue.backends.fmu`: an FMU in the role of the tissue, as a process of its own; by default the abdomen."""

from palpate_bus.run import main
from palpate_models.load import load_scenario
from palpate_tissue.backends.fmu.service import create

if __name__ == "__main__":
    main("tissue", create, load_scenario)
