"""Runs the recorder on the bus."""

from palpate_bus.run import main

from palpate_recorder.service import create

main("recorder", create)
