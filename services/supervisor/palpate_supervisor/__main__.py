"""`python -m palpate_supervisor`: the safety supervisor as a process of its own."""

from palpate_bus.run import main
from palpate_models.load import load_scenario
from palpate_supervisor.service import create

if __name__ == "__main__":
    main("supervisor", create, load_scenario)
