"""`python -m palpate_tissue.backends.fmu`: an FMU as a process of its own; by default the abdomen in the role of the tissue."""

from palpate_bus.run import main
from palpate_models.load import load_scenario
from palpate_tissue.backends.fmu.service import chosen_role, create

if __name__ == "__main__":
    main(chosen_role(), create, load_scenario)
