"""Runs the camera as a process: `python -m palpate_camera`."""

from palpate_bus.run import main

from palpate_camera.service import create

if __name__ == "__main__":
    main("camera", create)
