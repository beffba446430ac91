"""Runs perception as a process: `python -m palpate_perception`."""

from palpate_bus.run import main

from palpate_perception.service import create

if __name__ == "__main__":
    main("perception", create)
