"""`python -m palpate_planning`: the planning service as a process."""

from palpate_bus.run import main
from palpate_models.load import load_scenario
from palpate_planning.service import create

if __name__ == "__main__":
    main("planning", create, load_scenario)
