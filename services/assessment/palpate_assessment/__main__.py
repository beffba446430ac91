"""`python -m palpate_assessment`: the assessment service as a process."""

from palpate_assessment.service import create
from palpate_bus.run import main
from palpate_models.load import load_scenario

if __name__ == "__main__":
    main("assessment", create, load_scenario)
